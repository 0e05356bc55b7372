"""The geometry of two cameras on one vehicle, from what matches in many pairs of their images.

Points are those of :mod:`~calib_toolkit_plugins.epipolar`, b's turned beforehand so that little turn is left.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit_plugins.epipolar import Points, pose_of, tangent
from calib_toolkit_plugins.two_view import TwoViewMotion, turn

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

GATE, CUT = 3.0, 4.685  # sigmas; beyond the second a match counts nothing (Tukey's biweight)
LEVER = 3.0  # times the median parallax, beyond which more of it does not tell more
BIAS = 0.05  # sigmas by which features of a cell err alike: sampling, lens
MIN_MOVED, MIN_IN_FRONT = 30, 0.8  # so many must show parallax, and such a part of these the same way
AS_GOOD, SAME = 0.95, 50.0  # part of the best score, and squared sigmas from it, that make another solution a rival
MAX_DIRECTION_SIGMA = 0.5  # radians
RESAMPLES = 100


@dataclass(frozen=True)
class Matches:
    """Features that match. row, cell: (n,) in which images, and where in a's."""

    a: Points
    b: Points
    row: Rows
    cell: Rows


def solve(m: Matches) -> TwoViewMotion | None:
    """The turn and the direction on which most matches agree, or None if another explains them nearly as well.

    Started from directions all around, since with little parallax there are many minima.
    """
    fits = [_refined(m, R, t) for R, t in [*((np.eye(3), t) for t in np.eye(3)), *_usac(m)]]
    seen = [(r, along) for r, _, _, along in (_residuals(m, *fit) for fit in fits)]
    noise = min(_weights(*view)[1] for view in seen)
    scores = np.array([_weights(*view, noise)[0].sum() for view in seen])
    best = int(np.argmax(scores))
    (R, t), (r, along) = fits[best], seen[best]
    moved = (np.abs(along) > GATE * noise) & (np.abs(r) < GATE * noise)
    forward = float(np.mean(along[moved] > 0)) if moved.sum() >= MIN_MOVED else 0.5
    t = t if forward > 0.5 else -t
    cov = _covariance(m, R, t) if max(forward, 1 - forward) >= MIN_IN_FRONT else None
    if cov is None or np.linalg.eigvalsh(cov[3:, 3:])[-1] > MAX_DIRECTION_SIGMA**2:
        R, cov, squares = turn(m.a, m.b)
        return TwoViewMotion(R, None, cov, squares < GATE**2)
    for (R_other, t_other), score in zip(fits, scores, strict=True):
        e = np.append(se3.log_so3(R_other @ R.T), tangent(t).T @ (t_other * np.sign(t @ t_other)))
        if score > AS_GOOD * scores[best] and e @ np.linalg.solve(cov, e) > SAME:
            return None
    return TwoViewMotion(R, t, cov, _weights(r, along)[0] > 0)


def _usac(m: Matches) -> list[tuple[Array, Array]]:
    """The pose by OpenCV's MAGSAC++, a successor of the paper's MAPSAC, if it finds one."""
    import cv2

    noise = float(np.sqrt(np.median(np.trace(m.a.cov, axis1=1, axis2=2)) / 2))
    E, mask = cv2.findEssentialMat(m.b.xy, m.a.xy, np.eye(3), cv2.USAC_MAGSAC, 0.9999, GATE * noise)
    if E is None or np.shape(E) != (3, 3) or not np.all(np.isfinite(E)):
        return []
    inliers = mask.ravel() > 0
    return [pose_of(np.asarray(E, np.float64), m.a[inliers], m.b[inliers])]


def _residuals(m: Matches, R: Array, t: Array) -> tuple[Array, Array, Array, Array]:
    """How far, in sigmas, each point of a is from the line on which its partner in b lies, whatever the depth: (n,).

    Also its Jacobian (n, 5) over ``[delta, tangent]``, what the points' noise puts into that, and parallax (n,) in
    sigmas. With little parallax points form a narrow cloud about the line, whose narrowest direction is unbiased if
    the noise is taken across the line as it turns.
    """
    y = m.b.rays @ R.T
    xy = y[:, :2] / y[:, 2:]
    P = np.concatenate([np.broadcast_to(np.eye(2), (len(xy), 2, 2)), -xy[:, :, None]], axis=2) / y[:, 2, None, None]
    D = (P @ R)[:, :, :2]
    cov = m.a.cov + D @ m.b.cov @ D.transpose(0, 2, 1)
    way = t[:2] - t[2] * xy
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
    u = way / length
    n = np.column_stack([-u[:, 1], u[:, 0]])
    off = m.a.xy - xy
    across, along = np.sum(n * off, axis=1), np.sum(u * off, axis=1)
    var, mixed, var_along = (np.einsum("ni,nij,nj->n", p, cov, q) for p, q in ((n, n), (u, n), (u, u)))
    d_xy = P @ -se3.skew(y)
    B = tangent(t)
    turned = np.concatenate([-t[2] * d_xy, B[:2] - xy[:, :, None] * B[2]], axis=2)  # how way moves
    phi = np.einsum("ni,nik->nk", n, turned) / length
    J = np.pad(-np.einsum("ni,nik->nk", n, d_xy), ((0, 0), (0, 2)))
    J -= phi * (along - across * mixed / var)[:, None]
    sigma = np.sqrt(var)
    noise = phi * np.sqrt(np.maximum(var_along - mixed**2 / var, 0.0) / var)[:, None]
    return across / sigma, J / sigma[:, None], noise, along / np.sqrt(var_along)


def _weights(r: Array, along: Array, noise: float | None = None) -> tuple[Array, float]:
    """Tukey's weights (n,) of residuals, and their sigma. Parallax out of the ordinary counts less.

    A wrong match that happens to lie on its line would else tell the direction better than all others.
    """
    noise = noise or max(1.4826 * float(np.median(np.abs(r))), 1e-9)
    near = np.maximum(1 - (r / (CUT * noise)) ** 2, 0.0) ** 2
    usual = LEVER * max(float(np.median(np.append(np.abs(along[near > 0]), noise))), noise)
    way = np.sign(np.sum(np.sign(along[np.abs(along) > GATE * noise])))
    ahead = way * along > -GATE * noise
    return near * np.minimum(usual / np.maximum(np.abs(along), 1e-9), 1.0) ** 2 * ahead, noise


def _refined(m: Matches, R: Array, t: Array) -> tuple[Array, Array]:
    """(R, t) of least robust residuals, by reweighted Gauss-Newton steps."""
    for _ in range(40):
        r, J, _, along = _residuals(m, R, t)
        weighted = J * _weights(r, along)[0][:, None]
        step = np.linalg.lstsq(weighted.T @ J, -weighted.T @ r, rcond=1e-14)[0]
        step *= min(1.0, 0.3 / float(np.linalg.norm(step) + 1e-12))
        R, t = se3.exp_so3(step[:3]) @ R, t + tangent(t) @ step[3:]
        t = t / np.linalg.norm(t)
        if np.abs(step).max() < 1e-7:
            break
    return R, t


def _covariance(m: Matches, R: Array, t: Array) -> Array | None:
    """(5, 5) of ``[delta, tangent]``, or None where noise alone explains what seems to tell the direction.

    Bootstrap over rows, each resample solved by one Gauss-Newton step, not smaller than the delta method's; and what
    the features of a cell have in common, which no further image averages out.
    """
    r, J, J_noise, along = _residuals(m, R, t)
    weight, noise = _weights(r, along)
    w, rows = weight[:, None], int(m.row.max()) + 1
    H = (w * J).T @ J - noise**2 * (w * J_noise).T @ J_noise
    if np.linalg.eigvalsh(H)[0] <= 0:
        return None
    inverse, score = np.linalg.inv(H), w * J * r[:, None]
    by_row, by_cell = np.zeros((rows, 5)), np.zeros((int(m.cell.max()) + 1, 5))
    np.add.at(by_row, m.row, score)
    np.add.at(by_cell, m.cell, BIAS * w * J)
    analytic, common = inverse @ (score.T @ score) @ inverse, inverse @ (by_cell.T @ by_cell) @ inverse
    counts = np.random.default_rng(0).multinomial(rows, np.full(rows, 1 / rows), RESAMPLES)
    steps = counts @ by_row @ inverse
    bootstrap = steps.T @ steps / len(steps)
    L = np.linalg.cholesky(analytic)
    values, vectors = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, bootstrap).T))
    larger = L @ vectors
    return (larger * np.maximum(values, 1.0)) @ larger.T + common
