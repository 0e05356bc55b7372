"""What the methods are compared with: two sensors' hand-eye calibration without any variance.

Every step k of two sensors satisfies ``A_k X = X B_k`` with ``X = T_a_b``, A and B the motions of a and b.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.errors import NotObservableError
from calib_toolkit.sync import Steps

Array = NDArray[np.float64]

LEAST_SQUARES = "least-squares"
OPENCV_METHODS = {"opencv-tsai": "TSAI", "opencv-park": "PARK", "opencv-daniilidis": "DANIILIDIS"}
POSES = 200
"""OpenCV compares every pose with every other one."""


def least_squares(steps: Steps) -> Array:
    """``T_a_b`` (4, 4) of steps of two sensors: Kabsch on the rotation vectors, then linear least squares (VIII-D).

    Every step weighs the same, but they are those that the paper's gate of ten sigma leaves, on clock offsets that
    a method found. The translation is nan unless both sensors have scale. Raises NotObservableError.
    """
    (w_a, w_b), (p_a, p_b) = steps.vec[..., 3:], steps.vec[..., :3]
    R = kabsch(w_a, w_b)
    if not steps.has_scale.all():
        return se3.rigid(R, np.full(3, np.nan))
    A = se3.exp_so3(w_a) - np.eye(3)
    t = np.linalg.lstsq(A.reshape(-1, 3), (p_b @ R.T - p_a).ravel(), rcond=None)[0]
    return se3.rigid(R, t)


def kabsch(w_a: Array, w_b: Array) -> Array:
    """The rotation (3, 3) that best takes vectors b (m, 3) to vectors a (m, 3). Raises NotObservableError."""
    if len(w_a) < 2:
        raise NotObservableError(f"a rotation takes at least two common steps, and there are {len(w_a)}")
    U, _, Vt = np.linalg.svd(w_a.T @ w_b)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def opencv_has_hand_eye() -> bool:
    """Whether the installed OpenCV has ``calibrateHandEye``: 4.x has, 5 has not."""
    import cv2

    return hasattr(cv2, "calibrateHandEye")


def opencv_hand_eye(steps: Steps, method: str) -> Array:
    """``T_a_b`` (4, 4) by OpenCV's ``calibrateHandEye``. method: a key of ``OPENCV_METHODS``.

    Raises NotObservableError if one sensor has no scale, or if OpenCV finds nothing.
    """
    import cv2

    library: Any = cv2  # OpenCV 5 does not know what is asked of it here
    if not steps.has_scale.all():
        raise NotObservableError("OpenCV's hand-eye calibration takes two sensors that measure distances")
    # products of steps satisfy AX = XB too, even across steps that are missing
    T_world_a, T_world_b = (_chained(se3.matrix(vec)) for vec in steps.vec)
    kept = np.unique(np.linspace(0, len(T_world_a) - 1, POSES).astype(int))
    a, b = T_world_a[kept], se3.invert(T_world_b[kept])
    try:
        R, t = library.calibrateHandEye(
            list(a[:, :3, :3]),
            list(a[:, :3, 3]),
            list(b[:, :3, :3]),
            list(b[:, :3, 3]),
            method=getattr(cv2, f"CALIB_HAND_EYE_{OPENCV_METHODS[method]}"),
        )
    except cv2.error as e:
        raise NotObservableError(f"OpenCV's hand-eye calibration gave up ({str(e).strip().splitlines()[-1]})") from e
    T: Array = se3.rigid(R, np.reshape(t, 3))
    if not np.isfinite(T).all():
        raise NotObservableError("OpenCV's hand-eye calibration found no finite pose")
    return T


def _chained(T: Array) -> Array:
    poses = [np.eye(4)]
    for step in T:
        poses.append(poses[-1] @ step)
    return np.array(poses)
