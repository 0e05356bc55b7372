"""Camera to camera: what both see at the same instant (paper, section VII-C).

The matches of all rows show one geometry and are solved together. Points are those of
:mod:`~calib_toolkit_plugins.epipolar`, b's turned into the axes of a by the prior: what is left is a small turn,
and the direction to b. The intrinsics are believed: the sigmas do not include their errors.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib_toolkit import CameraIntrinsics, Pair, PairEstimate, Stream, Transform, hookimpl, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.epipolar import Points, tangent
from calib_toolkit_plugins.metrics.matching_geometry import Matches, solve
from calib_toolkit_plugins.monocular import normalise
from calib_toolkit_plugins.two_view import TwoViewMotion

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

TOGETHER = 0.003  # seconds between images of one trigger, as far as the clock offset is known
MIN_OVERLAP, GRID = 0.1, 24  # of a picture, for far points, asked for at so many points across it
SLACK = np.array([0.05] * 3 + [0.01] * 3)  # metres and radians by which the prior's sigma may be too small
GATE = 3.0  # sigmas
NEAREST = 2.0  # metres to the nearest thing that both may see
UNLIKE = 0.8  # similarity of descriptors that different things may have
COARSE = 6.0  # pixels of a feature's diameter from which on it is located the worse the larger it is
CELLS = 6  # across a picture, in each of which features err alike
MIN_CELLS = 4  # with matches
MIN_MATCHES, MIN_AGREE = 300, 0.75  # so many must agree, and such a part; with fewer, direction and turn get mixed up
UNKNOWN_VAR = 1e4  # of what does not show
NOTHING = Points(np.zeros((0, 2)), np.zeros((0, 2, 2)))


@dataclass(frozen=True)
class MatchingOptions:
    """features: at most so many in each image. ratio: how far a match's descriptor may be, compared with the next
    best. point_sigma: noise of a small feature, pixels; a first guess, the residuals tell.
    """

    features: int = 1500
    ratio: float = 0.8
    point_sigma: float = 0.4


@hookimpl
def calib_register_metrics() -> list["Matching"]:
    """The ``matching`` metric."""
    return [Matching()]


class Matching:
    """Rotation, and direction of translation, between two cameras that see the same things."""

    id = "matching"
    options: type = MatchingOptions

    def accepts(self, kind_a: str, kind_b: str) -> bool:
        """Two cameras."""
        return {kind_a, kind_b} <= {"monocular", "ladybug"}

    def overlap(self, pair: Pair) -> bool:
        """Whether a tenth of one picture's far points may lie in the other, within a sigma of the prior."""
        return len(_together(pair)) > 0 and _overlap(pair) >= MIN_OVERLAP

    def estimate(self, pair: Pair, options: MatchingOptions) -> PairEstimate:
        """``T_a_b`` with a translation of unit length; its covariance is zero along it, and of rank two.

        Where nothing shows parallax only the rotation is told, and the translation's covariance is wide all around.
        The clock's error matters no more once rows not taken together are left out. Raises DataError.
        """
        import cv2

        cv2.setNumThreads(1)  # pairs are compared in parallel
        rows, names = _together(pair), f"{pair.a.name} and {pair.b.name}"
        left_out = len(pair) - len(rows)
        also = [f"{left_out} of {len(pair)} rows left out, not taken together"] if left_out else []
        if not len(rows):
            return _failed(pair, [f"no images of {names} were taken at the same instant", *also])
        m = _matches(pair, rows, options)
        n = len(m.row)
        if n < MIN_MATCHES:
            return _failed(pair, [f"{names} have {n} features in common, too few", *also])
        found = solve(m)
        inlier = np.zeros(n, bool) if found is None else found.inliers
        share, cells = float(np.mean(inlier)), len(np.unique(m.cell[inlier]))
        told = {"rows": float(len(rows)), "matches": float(n), "agree": share}
        if found is None or cells < MIN_CELLS:
            return _failed(pair, [f"{names} see too little in common to tell one place from another", *also], told)
        if share < MIN_AGREE or share * n < MIN_MATCHES:
            return _failed(pair, [f"of {n} features that match in {names} {share:.0%} agree, too few", *also], told)
        only = [] if found.t is not None else [f"{names} show no parallax, so only their rotation is known"]
        return PairEstimate(self.id, _transform(pair, found), note="; ".join([*only, *also]), statistics=told)


def _together(pair: Pair) -> Rows:
    """The selected rows (k, 2) whose images were taken at one instant."""
    gap = pair.a.stamps[pair.selected[:, 0]] - pair.b.stamps[pair.selected[:, 1]] - pair.dt_a_b
    return pair.selected[np.abs(gap) < TOGETHER]


def _overlap(pair: Pair) -> float:
    """Share of a picture whose far points may lie in the other."""
    (a, apart_a), (b, apart_b) = _grid(pair.a), _grid(pair.b)
    variances, axes = np.linalg.eigh(pair.prior.cov[3:, 3:])
    sigmas = (axes * np.sqrt(np.maximum(variances, 0.0))).T
    turns = se3.exp_so3(np.concatenate([np.zeros((1, 3)), sigmas, -sigmas]))
    shares = []
    for turned in b @ np.swapaxes(turns @ pair.prior.T_a_b[:3, :3], 1, 2):
        shares += [np.mean(cKDTree(turned).query(a)[0] < apart_b), np.mean(cKDTree(a).query(turned)[0] < apart_a)]
    return float(max(shares))


def _grid(camera: Stream) -> tuple[Array, float]:
    """Unit rays (n, 3) all over a camera's picture, and how far from one a ray in between may be, radians."""
    lens, (h, w) = _lens(camera), np.shape(camera.readings[0])[:2]
    step = max(w, h) / GRID
    pixels = np.stack(np.meshgrid(np.arange(step / 2, w, step), np.arange(step / 2, h, step)), 2).reshape(-1, 2)
    points, usable = normalise(pixels, lens, 1.0)
    if lens.mask is not None:
        usable &= lens.mask[tuple(pixels.astype(int).T[::-1])] > 0
    return _unit(points.rays[usable]), 0.75 * step / float(lens.K[0, 0])


def _lens(camera: Stream) -> CameraIntrinsics:
    if camera.intrinsics is None:
        raise DataError(f"sensor {camera.name} has no intrinsics; give its camera matrix")
    return camera.intrinsics


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _matches(pair: Pair, rows: Rows, options: MatchingOptions) -> Matches:
    """What the images of all rows have in common."""
    found = [_alike(pair, int(i), int(j), options) for i, j in rows]
    a, b = (
        Points(np.concatenate([p.xy for p in side]), np.concatenate([p.cov for p in side]))
        for side in zip(*found, strict=True)
    )
    width = np.shape(pair.a.readings[0])[1] / float(_lens(pair.a).K[0, 0])
    cell = np.unique(np.floor(a.xy * CELLS / width), axis=0, return_inverse=True)[1].ravel()
    return Matches(a, b, np.repeat(np.arange(len(rows)), [len(p.xy) for p, _ in found]), cell)


def _alike(pair: Pair, i: int, j: int, options: MatchingOptions) -> tuple[Points, Points]:
    """Points of image i of a and j of b with mutually nearest descriptors, where the prior allows them."""
    R, t, cov = pair.prior.T_a_b[:3, :3], pair.prior.T_a_b[:3, 3], pair.prior.cov + np.diag(SLACK**2)
    (a, like_a), (b, like_b) = _features(pair.a, i, options, np.eye(3)), _features(pair.b, j, options, R)
    if not len(a.xy) or not len(b.xy):
        return NOTHING, NOTHING
    x, y = _unit(a.rays), _unit(b.rays)
    far, off = (GATE * float(np.sqrt(np.linalg.eigvalsh(c)[-1])) for c in (cov[:3, :3], cov[3:, 3:]))
    reach = min(off + (float(np.linalg.norm(t)) + far) / NEAREST, np.pi)
    like = np.where(x @ y.T > np.cos(reach), like_a @ like_b.T, 0.0)
    first, n = np.argmax(like, axis=1), np.arange(len(x))
    mutual, best = np.argmax(like, axis=0)[first] == n, like[n, first]
    like[n, first] = UNLIKE
    n = n[mutual & (1 - best < options.ratio**2 * (1 - np.maximum(like.max(axis=1), UNLIKE)))]
    n = n[np.unique(a.xy[n], axis=0, return_index=True)[1]]  # a corner with two orientations is one
    x, y = x[n], y[first[n]]
    # the epipolar error's gradient over the prior's translation and rotation
    J = np.concatenate([np.cross(y, x), x * (y @ t)[:, None] - np.outer(np.sum(x * y, axis=1), t)], axis=1)
    n = n[np.abs(np.cross(y, x) @ t) < GATE * np.sqrt(np.einsum("ni,ij,nj->n", J, cov, J))]
    k = first[n]
    return Points(a.xy[n], a.cov[n]), Points(b.xy[k], b.cov[k])


def _features(camera: Stream, k: int, options: MatchingOptions, R: Array) -> tuple[Points, NDArray[np.float32]]:
    """Features of one image seen from axes turned by R, and descriptors (n, 128): SIFT's, by Hellinger's distance."""
    import cv2

    image, lens = np.asarray(camera.readings[k]), _lens(camera)
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    # OpenCV's stubs lack SIFT
    sift = cv2.SIFT_create(options.features, enable_precise_upscale=True)  # type: ignore[attr-defined]
    keys, histograms = sift.detectAndCompute(np.ascontiguousarray(grey), lens.mask)
    if not len(keys):
        return NOTHING, np.zeros((0, 128), np.float32)
    points, usable = normalise(np.array([key.pt for key in keys], float), lens, options.point_sigma)
    coarser = np.maximum(np.array([key.size for key in keys]) / COARSE, 1.0)
    y = points.rays @ R.T
    usable &= y[:, 2] > 0.1
    z = np.where(usable, y[:, 2], 1.0)[:, None]
    xy = y[:, :2] / z
    D = (R[:2, :2] - xy[:, :, None] * R[2, :2]) / z[:, :, None]
    cov = coarser[:, None, None] ** 2 * (D @ points.cov @ D.transpose(0, 2, 1))
    roots = np.sqrt(histograms / np.maximum(histograms.sum(axis=1, keepdims=True), 1e-9))
    return Points(xy[usable], cov[usable]), np.asarray(roots[usable], np.float32)


def _transform(pair: Pair, found: TwoViewMotion | None) -> Transform:
    """What was found, or nothing, as a transform with a translation of unit length."""
    T, cov = pair.prior.T_a_b.copy(), UNKNOWN_VAR * np.eye(6)
    length = float(np.linalg.norm(T[:3, 3]))
    T[:3, 3] = T[:3, 3] / length if length > 0 else [0.0, 0.0, 1.0]
    if found is not None:
        T[:3, :3] = found.R @ T[:3, :3]
        cov[3:, 3:] = found.cov[:3, :3]
        if found.t is not None:
            T[:3, 3] = found.t
            J = np.zeros((6, 5))
            J[:3, 3:], J[3:, :3] = tangent(found.t), np.eye(3)
            cov = J @ found.cov @ J.T
    return Transform(pair.prior.a, pair.prior.b, T, cov, has_scale=False)


def _failed(pair: Pair, why: list[str], told: dict[str, float] | None = None) -> PairEstimate:
    return PairEstimate(
        Matching.id, _transform(pair, None), converged=False, note="; ".join(why), statistics=told or {}
    )
