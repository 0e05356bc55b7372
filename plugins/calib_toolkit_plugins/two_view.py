"""Motion of a camera between two images, from points that both see (paper, section V-B): which points agree on what.

The geometry, and what ``prev`` and ``curr`` hold, is in :mod:`~calib_toolkit_plugins.epipolar`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit_plugins.epipolar import (
    Array,
    Mask,
    Points,
    covariance,
    eight_point,
    in_front,
    pose_of,
    refine,
    sampson,
)

GATE, WIDE_GATE = 3.0, 5.0  # sigmas of a Sampson residual; beyond it a point is an outlier (at first, a wider one)
RANGE_OF_NOISE = (0.2, 1.0)  # the measured noise tightens the gate, within these parts of the stated noise
CAUCHY = 1.31  # times the variance of least squares, what such weights leave of Gaussian noise
MIN_POINTS = 20
MIN_SHARE = 0.4  # of the points must agree with the motion, or it is no motion of the scene
MIN_IN_FRONT = 2 / 3  # of the agreeing points must lie in front of both cameras, or the sign is a guess
MIN_ON_PLANE = 0.8  # of the points make a scene a plane
AS_GOOD = 1.5  # times the squared residuals of the best, and another motion is not refuted
MIN_APART = 0.1  # radians between directions that count as two
MAX_STILL = 0.6  # of the points may stay where a turn puts them; else those that move may all be other traffic
MAX_DIRECTION_SIGMA = 0.5  # radians; beyond it the sphere is not flat and the direction counts as unknown


@dataclass(frozen=True)
class TwoViewMotion:
    """Motion between two images.

    R, t: of ``T_prev_curr``, t of unit length, or None where only the rotation could be seen.
    cov: (5, 5) of ``[delta (3), tangent (2)]``,
    the tangent in the axes of :func:`~calib_toolkit_plugins.epipolar.tangent`; (3, 3) when t is None.
    inliers: (n,) the points that agree.
    """

    R: Array
    t: Array | None
    cov: Array
    inliers: Mask


def two_view_motion(prev: Points, curr: Points) -> TwoViewMotion | None:
    """Motion between two images from matched points, or None where the points agree on none.

    Successors of the paper's MAPSAC find the inliers (OpenCV's USAC: graph-cut RANSAC with its MSAC score, and
    MAGSAC++), the normalised eight-point algorithm [24] and cheirality the pose, and a few damped Gauss-Newton steps
    the least Sampson error, where the covariance holds. Where turning alone explains the points as well (Torr's GRIC:
    a standing or purely turning camera), or most of them, the direction is not determined and t is None. A scene that
    is one plane can have two motions; then only a turn is considered.
    """
    if len(prev.xy) < MIN_POINTS:
        return None
    R_turn, cov_turn, squares = turn(prev, curr)
    pose = _move(prev, curr)
    if pose is not None:
        R, t, inliers = pose
        r = sampson(prev, curr, R, t)[0]
        still = np.mean(squares < (GATE * _noise(r)) ** 2)
        p, c = prev[inliers], curr[inliers]
        if _gric(r**2, 3, 5) < _gric(squares, 2, 3) and still < MAX_STILL and not _ambiguous(p, c, R, t):
            cov = CAUCHY * covariance(p, c, R, t)
            seen = np.max(np.diag(cov)[3:]) < MAX_DIRECTION_SIGMA**2 and np.mean(in_front(p, c, R, t)) > MIN_IN_FRONT
            return TwoViewMotion(R, t, cov, inliers) if seen else TwoViewMotion(R, None, cov[:3, :3], inliers)
    agree = squares < GATE**2
    return TwoViewMotion(R_turn, None, cov_turn, agree) if _enough(agree) else None


def turn(prev: Points, curr: Points) -> tuple[Array, Array, Array]:
    """(R, cov (3, 3) of delta, squared residuals (n,) in sigmas) of the turn that explains most points alone.

    Robust (Cauchy weights about the median residual). A translation too small to see still moves all points a
    little, and the turn takes up part of that: the covariance includes the mean square of what it left over.
    """
    R, x, W = np.eye(3), curr.rays, np.linalg.inv(prev.cov + curr.cov)
    for _ in range(30):
        y = x @ R.T
        y[:, 2] = np.maximum(y[:, 2], 1e-3)  # what turns out of view is an outlier, not an error
        P = y[:, :2] / y[:, 2:]
        left = prev.xy - P
        D = np.concatenate([np.broadcast_to(np.eye(2), (len(P), 2, 2)), -P[:, :, None]], axis=2) / y[:, 2, None, None]
        J = D @ -se3.skew(y)
        squares = _squares(left, W)
        weight = 1 / (1 + squares / max(1.0, float(np.median(squares))))
        H = np.einsum("n,nia,nij,njb->ab", weight, J, W, J, optimize=True)
        step = np.linalg.solve(H, np.einsum("n,nia,nij,nj->a", weight, J, W, left, optimize=True))
        R = se3.exp_so3(step) @ R
        if np.linalg.norm(step) < 1e-9:
            break
    near = squares < GATE**2
    leftover = float(np.mean(np.sum(left[near] ** 2, axis=1))) if near.any() else np.inf
    return R, np.linalg.inv(H) + np.diag([leftover] * 3), squares


def _move(prev: Points, curr: Points) -> tuple[Array, Array, Mask] | None:
    """(R, t, inliers) if the camera also moved, or None where too few points agree."""
    import cv2

    noise = float(np.sqrt(np.median(np.trace(prev.cov, axis1=1, axis2=2)) / 2))
    fits: list[tuple[Array, Array, Mask]] = []
    for method in (cv2.USAC_ACCURATE, cv2.USAC_MAGSAC):  # it has many minima; neither always starts at the best
        E, mask = cv2.findEssentialMat(curr.xy, prev.xy, np.eye(3), method, 0.9999, GATE * noise)
        inliers = np.zeros(len(prev.xy), bool) if E is None or np.shape(E) != (3, 3) else mask.ravel() > 0
        if _enough(inliers) and np.all(np.isfinite(E)):
            p, c = prev[inliers], curr[inliers]
            # eight points of a plane determine nothing; the consensus model comes from five
            for start in (eight_point(p, c), np.asarray(E, np.float64)):
                fits += _regated(prev, curr, *pose_of(start, p, c), WIDE_GATE)
    for _ in range(2):
        best = sorted(fits, key=lambda fit: np.sum(np.minimum(sampson(prev, curr, *fit[:2])[0] ** 2, GATE**2)))[:1]
        fits = [fit for R, t, _ in best for fit in _regated(prev, curr, R, t, GATE)]
    if not fits:
        return None
    R, t, inliers = fits[0]
    p, c = prev[inliers], curr[inliers]
    # where one thing hides another, corners of their outlines lie on neither: they err within the gate, all one way
    return *refine(p, c, R, t, _noise(sampson(p, c, R, t)[0])), inliers


def _regated(prev: Points, curr: Points, R: Array, t: Array, gate: float) -> list[tuple[Array, Array, Mask]]:
    """The pose refined on the points within the gate, and these inliers; nothing where too few agree."""
    r = np.abs(sampson(prev, curr, R, t)[0])
    inliers = (r < gate * _noise(r)) & ~_behind(prev, curr, R, t)
    return [(*refine(prev[inliers], curr[inliers], R, t), inliers)] if _enough(inliers) else []


def _behind(prev: Points, curr: Points, R: Array, t: Array) -> Mask:
    """(n,) whether a point moved along its epipolar line the wrong way, by more than its noise."""
    y = curr.rays @ R.T
    far = y[:, :2] / y[:, 2:]
    way = t[:2] - t[2] * far  # of nearer points
    moved = np.sum((prev.xy - far) * way, axis=1)
    return moved < -GATE * np.sqrt(_squares(way, prev.cov + curr.cov))


def _ambiguous(prev: Points, curr: Points, R: Array, t: Array) -> bool:
    """Whether the points lie on a plane, and its other motion explains them as well."""
    import cv2

    H: Any = cv2.findHomography(curr.xy, prev.xy)[0]
    if H is None:
        return False
    r = sampson(prev, curr, R, t)[0]
    y = curr.rays @ H.T
    squares = _squares(prev.xy - y[:, :2] / y[:, 2:], np.linalg.inv(prev.cov + curr.cov))
    if np.mean(squares < (GATE * _noise(r)) ** 2) < MIN_ON_PLANE:
        return False
    _, turns, shifts, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    for R_start, shift in zip(turns, shifts, strict=True):
        length = np.linalg.norm(shift)
        if length > 1e-9:
            R_other, t_other = refine(prev, curr, np.asarray(R_start, np.float64), shift.ravel() / length)
            as_good = np.sum(sampson(prev, curr, R_other, t_other)[0] ** 2) < AS_GOOD * (r @ r)
            in_view = np.mean(in_front(prev, curr, R_other, t_other)) > MIN_IN_FRONT
            if as_good and in_view and t @ t_other < np.cos(MIN_APART):
                return True
    return False


def _squares(left: NDArray[np.floating[Any]], W: NDArray[np.floating[Any]]) -> Array:
    """(n,) squared lengths of (n, 2) under (n, 2, 2)."""
    return np.einsum("ni,nij,nj->n", left, W, left)


def _noise(r: Array) -> float:
    """Robust sigma of residuals, within the range that is believed."""
    return float(np.clip(1.4826 * np.median(np.abs(r)), *RANGE_OF_NOISE))


def _enough(inliers: Mask) -> bool:
    return bool(np.sum(inliers) >= max(MIN_POINTS, MIN_SHARE * len(inliers)))


def _gric(squares: Array, dimension: int, parameters: int) -> float:
    """Torr's robust information criterion of a two-view model: lower explains better for what it costs."""
    n = len(squares)
    return float(
        np.sum(np.minimum(squares, 2.0 * (4 - dimension))) + n * dimension * np.log(4) + parameters * np.log(4 * n)
    )
