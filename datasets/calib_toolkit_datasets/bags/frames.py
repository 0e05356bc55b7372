"""Static transforms as the calibration that came with a recording."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Calibration, DataError, se3
from calib_toolkit_datasets.bags.poses import rotation

Array = NDArray[np.float64]


def edges(messages: Iterable[Any], where: str) -> dict[tuple[str, str], Array]:
    """``T_parent_child`` (4, 4) by (parent, child); the last of each counts. Raises DataError."""
    found: dict[tuple[str, str], Array] = {}
    for message in messages:
        for t in message.transforms:
            parent, child = t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
            p = t.transform.translation
            T = se3.rigid(rotation(t.transform.rotation, f"{where}: {child}").as_matrix(), np.array([p.x, p.y, p.z]))
            if not np.isfinite(T).all():
                raise DataError(f"{where}: the transform of {child} is not finite")
            found[parent, child] = T
    return found


def reference(
    T_parent_child: Mapping[tuple[str, str], Array], frames: Mapping[str, str], scaled: Mapping[str, bool]
) -> Calibration | None:
    """Poses of sensors whose frames hang together with that of the first, or None if there are none.

    frames: of each sensor. scaled: whether each measures distances. Clock offsets are not told.
    """
    known = [n for n, frame in frames.items() if any(frame in edge for edge in T_parent_child)]
    if not known:
        return None
    base = next((n for n in known if scaled[n]), known[0])
    reached = _from(frames[base], T_parent_child)
    names = [base, *(n for n in known if n != base and frames[n] in reached)]
    if len(names) < 2:
        return None
    determined = np.ones((len(names), 7), dtype=bool)
    determined[1:, 6] = False
    return Calibration(
        base=base,
        names=tuple(names),
        T_base_sensor=np.stack([reached[frames[n]] for n in names]),
        dt_base_sensor=np.zeros(len(names)),
        covariance=np.zeros((7 * len(names), 7 * len(names))),
        has_scale=np.array([scaled[n] for n in names]),
        determined=determined,
    )


def _from(first: str, T_parent_child: Mapping[tuple[str, str], Array]) -> dict[str, Array]:
    """``T_first_frame`` of every frame that hangs together with the first."""
    beside: dict[str, dict[str, Array]] = {}
    for (parent, child), T in T_parent_child.items():
        beside.setdefault(parent, {})[child] = T
        beside.setdefault(child, {})[parent] = se3.invert(T)
    reached, waiting = {first: np.eye(4)}, [first]
    while waiting:
        here = waiting.pop()
        for there, T in beside.get(here, {}).items():
            if there not in reached:
                reached[there] = reached[here] @ T
                waiting.append(there)
    return reached
