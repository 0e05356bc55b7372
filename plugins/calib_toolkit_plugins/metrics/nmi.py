"""NMI: how much of the image's brightness the lidar's intensity tells (paper, VII-A and [2])."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from calib_toolkit import Pair, Scan, hookimpl
from calib_toolkit.errors import ConfigError
from calib_toolkit_plugins.metrics.images import Image
from calib_toolkit_plugins.metrics.points import may_be_hidden
from calib_toolkit_plugins.metrics.views import Array, Index, LidarCamera, Moment, blurred

LEVELS = 1024
"""Of brightness, told apart before it is equalised."""


@dataclass(frozen=True)
class NmiOptions:
    """bins: of intensity and of brightness alike, each with about as many points (the author's program: 50)."""

    bins: int = 16

    def __post_init__(self) -> None:
        if not isinstance(self.bins, int) or not 2 <= self.bins <= 256:
            raise ConfigError(f"nmi: bins = {self.bins!r} is not a whole number from 2 to 256")


@dataclass(frozen=True)
class Binned(Moment):
    """A moment and into how many bins it is sorted."""

    bins: int = NmiOptions.bins


class Nmi(LidarCamera):
    """Normalised mutual information of lidar intensity and image brightness, negated."""

    id = "nmi"
    options = NmiOptions
    points = 8000
    candidates = 16000

    def prepare(self, pair: Pair, options: Any) -> Binned | None:
        """The scan and image of a row; None where the lidar tells no intensity."""
        made = super().prepare(pair, options)
        if made is None or not made.points.shape[1]:
            return None
        return Binned(**vars(made), bins=(options or NmiOptions()).bins)

    def facts(self, scan: Scan, chosen: Index) -> tuple[NDArray[np.bool_], dict[str, Array]]:
        """Intensity by rank, 0 to 1, of points that nothing may hide from the camera."""
        if scan.intensity is None or np.ptp(scan.intensity[chosen]) == 0:
            return np.zeros(len(chosen), dtype=bool), {}
        rank = (rankdata(scan.intensity[chosen]) - 0.5) / len(chosen)
        return ~may_be_hidden(scan.points, chosen), {"intensity": rank}

    def pictures(self, image: Image, blur: float) -> tuple[Image, ...]:
        """Brightness by rank among the image's pixels, 0 to 1."""
        smooth = blurred(image, blur)
        count, edges = np.histogram(smooth, LEVELS, (0.0, 1.0))
        rank = np.concatenate([[0.0], np.cumsum(count)]) / smooth.size
        return (np.interp(smooth, edges, rank).astype(np.float32),)

    def costs(self, T_a_b: Array, moment: Binned) -> Array:
        """(k,) ``-(H(A) + H(B)) / H(A, B)``: -1 of what has nothing in common, -2 of what is the same."""
        (((brightness,),), weight), n = moment.read(T_a_b), moment.bins
        row = np.minimum((moment.facts["intensity"] * n).astype(int), n - 1)
        # each point counts in the two nearest bins of brightness, so that no pose makes it jump
        place = brightness * (n - 1)
        low = np.minimum(place.astype(int), n - 2)
        part = (place - low) * weight
        cell = (np.arange(len(T_a_b))[:, None] * n + row) * n + low
        counts = np.bincount(
            np.concatenate([cell.ravel(), cell.ravel() + 1]),
            np.concatenate([(weight - part).ravel(), part.ravel()]),
            len(T_a_b) * n * n,
        )
        joint = counts.reshape(-1, n, n) / weight.sum(axis=1)[:, None, None]
        both = _entropy(joint.reshape(-1, n * n))
        return -(_entropy(joint.sum(axis=2)) + _entropy(joint.sum(axis=1))) / np.maximum(both, 1e-9)


@hookimpl
def calib_register_metrics() -> list[Any]:
    """The ``nmi`` metric."""
    return [Nmi()]


def _entropy(p: Array) -> Array:
    """(k,) of probabilities (k, n), nats."""
    return np.asarray(-np.sum(p * np.log(p + 1e-12), axis=1))
