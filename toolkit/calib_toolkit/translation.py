"""Where each sensor sits: sections VI-A3, VI-B3, VI-C and VI-D for the translations.

For a pair of sensors x and y (equation 14, in our notation and in base axes):

    (W - I) l + s p_y - p_x = 0,    l = t_x - t_y

``t_i`` is the position of sensor i in the base frame, ``p_i`` its translation over the step in base axes, and ``W``
the step's rotation as one of the two measured it; the sum (17) goes over both orders of a pair, so each takes its
turn. ``s`` is one for a sensor that has scale; for a camera, which is always y, it is solved in closed form at each
step (equation 16). Pairs without any scale are skipped.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import delta, se3
from calib_toolkit.likelihood import all_pairs, log_normal_3d, maximise, trimmed
from calib_toolkit.rotation import Rotations
from calib_toolkit.sync import Steps

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TranslationOptions:
    """trim: share of each pair's steps left out (VI-C1)."""

    trim: float = 0.25


@dataclass(frozen=True)
class Translations:
    """t_base_sensor: (n, 3) metres, nan for all but the base if no sensor has scale. cov: (3n, 3n), base axes."""

    t_base_sensor: Array
    cov: Array


@dataclass(frozen=True)
class Turned:
    """All motions in base axes. W: (n, m, 3, 3) rotation of each step; p: (n, m, 3) translation.

    cov_p, cov_w, cov_pw: (n, m, 3, 3) of p and of ``delta`` in ``W_true = Exp(delta) W``.
    cov_turns: (3n, 3n) of the sensors' own turns against the base.
    """

    has_scale: NDArray[np.bool_]
    W: Array
    p: Array
    cov_p: Array
    cov_w: Array
    cov_pw: Array
    cov_turns: Array


def estimate(steps: Steps, rotations: Rotations, options: TranslationOptions) -> Translations:
    """Positions of all sensors in the first one's frame. With no scale anywhere there are none."""
    n = len(steps.vec)
    if not steps.has_scale.any():
        return Translations(np.vstack([np.zeros(3), np.full((n - 1, 3), np.nan)]), np.zeros((3 * n, 3 * n)))
    motion = turn(steps, rotations)
    start = initialise(motion)
    terms = likelihood_terms(start, motion)
    t = optimise(start, terms, options)
    return Translations(t, uncertainty(t, terms, motion, options))


def turn(steps: Steps, rotations: Rotations) -> Turned:
    """The motions seen from base axes."""
    R = rotations.R_base_sensor
    w, p = se3.turn_vectors(R, steps.vec[..., 3:]), se3.turn_vectors(R, steps.vec[..., :3])
    blocks = ((slice(3), slice(3)), (slice(3), slice(3, 6)), (slice(3, 6), slice(3, 6)))
    pp, pw, ww = (se3.turn_covs(R, steps.cov[..., a, b]) for a, b in blocks)
    # what is uncertain about a rotation vector becomes a turn in the outer axes
    J = se3.left_jacobian(w)
    J_t = np.swapaxes(J, -1, -2)
    return Turned(steps.has_scale, se3.exp_so3(w), p, pp, J @ ww @ J_t, pw @ J_t, rotations.cov)


def initialise(motion: Turned) -> Array:
    """Weighted least squares of equation (7) between the first sensor and each other one (VI-A3). (n, 3).

    A camera's steps are given the length that equation (8) would: that of the base's own motion, as if the
    camera sat where the base sits.
    """
    t = np.zeros((len(motion.p), 3))
    for i in range(1, len(t)):
        length = np.ones(motion.p.shape[1])
        if not motion.has_scale[i]:
            length = np.einsum("mi,mi->m", motion.p[i], motion.p[0])
        spread = np.trace(motion.cov_p[0] + length[:, None, None] ** 2 * motion.cov_p[i], axis1=1, axis2=2)
        weight = 1 / np.sqrt(spread)
        A = (np.eye(3) - motion.W[i]) * weight[:, None, None]
        b = (motion.p[0] - length[:, None] * motion.p[i]) * weight[:, None]
        t[i] = np.linalg.lstsq(A.reshape(-1, 3), b.reshape(-1), rcond=None)[0]
    return t


def log_likelihood(t: Array, terms: "Sequence[Term]", options: TranslationOptions) -> float:
    """Equations (14) to (17): trimmed sum over all pairs that hold a sensor with scale. t: (n, 3)."""
    each = [log_normal_3d(*term.residual(t[term.x] - t[term.y])) for term in terms]
    return 0.5 * sum(trimmed(e, options.trim)[0] for e in each)


def optimise(start: Array, terms: "Sequence[Term]", options: TranslationOptions) -> Array:
    """The positions of highest likelihood. (n, 3)."""

    def positions(p: Array) -> Array:
        return np.vstack([np.zeros(3), p.reshape(-1, 3)])

    expected = _sums(start, terms, options).cramer_rao()
    found = maximise(lambda p: log_likelihood(positions(p), terms, options), start[1:].ravel(), expected)
    return positions(found)


def uncertainty(t: Array, terms: "Sequence[Term]", motion: Turned, options: TranslationOptions) -> Array:
    """Covariance (3n, 3n) of the positions: the larger of Cramer-Rao and the approximate delta method (VI-D1)."""
    sums = _sums(t, terms, options)
    readings = np.block([[motion.cov_p, motion.cov_pw], [np.swapaxes(motion.cov_pw, -1, -2), motion.cov_w]])
    full = np.zeros((t.size, t.size))
    full[3:, 3:] = delta.larger(sums.cramer_rao(), sums.approximate_delta(readings))
    # the sensors' turns are wrong by the same amount at every step, which no number of steps averages out
    by_turns = sums.cramer_rao() @ _mixed_with_turns(t, terms, options)
    full[3:, 3:] += by_turns @ motion.cov_turns @ by_turns.T
    return full


@dataclass(frozen=True)
class Term:
    """One pair's residual at each step, as a function of the lever l between the two. (m, ...) throughout.

    D: the rotation less the identity. cov_y: of p_y, which counts with the square of its length.
    by_lever: (m, 9, 3) and by_lever_squared: (m, 9, 9) the part of the covariance that the rotation's noise
    makes, linear and quadratic in the lever.
    """

    x: int
    y: int
    turned_by: int
    unscaled: bool
    D: Array
    p_x: Array
    p_y: Array
    cov_rest: Array
    cov_y: Array
    by_lever: Array
    by_lever_squared: Array

    def residual(self, lever: Array) -> tuple[Array, Array]:
        """Equation (14) or (16), (m, 3), and its covariance by the delta method, (m, 3, 3)."""
        rest = _times(self.D, lever) - self.p_x
        length = self.length(rest)
        turned = _times(self.by_lever, lever)
        cov = self.cov_rest + length**2 * self.cov_y
        cov = cov + _times(self.by_lever_squared, np.outer(lever, lever).ravel())
        cov = cov + (length * turned if self.turned_by == self.y else -turned)
        if self.unscaled:
            # the solved length is uncertain too: variance of s, along p_y
            cov = cov + (np.einsum("mk,mk->m", self._outer, cov) / self._squared**2)[:, None] * self._outer
        return rest + length * self.p_y, cov.reshape(-1, 3, 3)

    def length(self, rest: Array) -> Array:
        """(m, 1) of y's translation: one, or what brings equation (16) nearest to zero."""
        if not self.unscaled:
            return np.ones((len(rest), 1))
        return (-np.einsum("mi,mi->m", self.p_y, rest) / self._squared)[:, None]

    @cached_property
    def _squared(self) -> Array:
        return np.maximum(np.einsum("mi,mi->m", self.p_y, self.p_y), 1e-12)

    @cached_property
    def _outer(self) -> Array:
        return np.einsum("mi,mj->mij", self.p_y, self.p_y).reshape(-1, 9)

    def jacobians(self, lever: Array) -> tuple[Array, Array, Array]:
        """Derivatives by the lever (m, 3, 3) and by x's and y's readings ``(p, delta)`` (m, 3, 6) each."""
        keep = np.broadcast_to(np.eye(3), self.D.shape)
        if self.unscaled:  # the solved length takes up whatever lies along p_y
            u = self.p_y / np.sqrt(self._squared)[:, None]
            keep = np.eye(3) - u[:, :, None] * u[:, None, :]
        length = self.length(self.D @ lever - self.p_x)
        by_turn = keep @ -se3.skew(self.D @ lever + lever)
        none = np.zeros_like(by_turn)
        by_x, by_y = (by_turn if self.turned_by == k else none for k in (self.x, self.y))
        return (
            keep @ self.D,
            np.concatenate([-keep, by_x], axis=2),
            np.concatenate([length[:, :, None] * keep, by_y], axis=2),
        )


def likelihood_terms(t: Array, motion: Turned) -> list[Term]:
    """Every pair's terms, in both orders: y is the camera, if one is; two cameras make none (VI-B3).

    What the turns of the sensors leave open is taken at the positions t given, since it hardly changes with them.
    """
    scaled = motion.has_scale
    ordered = [(x, y) if scaled[x] else (y, x) for x, y in all_pairs(len(scaled))]
    return [_term(t, motion, x, y, k) for x, y in ordered if scaled[x] for k in (y, x)]


def _term(t: Array, motion: Turned, x: int, y: int, k: int) -> Term:
    W, m = motion.W[k], motion.W.shape[1]
    # noise of the rotation: d(W l) = -[W l]x delta, so K = sum over axes a of l_a K_a
    K = -np.stack([se3.skew(W[:, :, a]) for a in range(3)])
    by_lever = K @ np.swapaxes(motion.cov_pw[k], 1, 2)
    by_lever = (by_lever + np.swapaxes(by_lever, 2, 3)).reshape(3, m, 9)
    by_lever_squared = np.stack(
        [K[a] @ motion.cov_w[k] @ np.swapaxes(K[b], 1, 2) for a in range(3) for b in range(3)]
    )
    term = Term(
        x,
        y,
        k,
        not motion.has_scale[y],
        W - np.eye(3),
        motion.p[x],
        motion.p[y],
        motion.cov_p[x].reshape(m, 9),
        motion.cov_p[y].reshape(m, 9),
        np.ascontiguousarray(by_lever.transpose(1, 2, 0)),
        np.ascontiguousarray(by_lever_squared.reshape(9, m, 9).transpose(1, 2, 0)),
    )
    return replace(term, cov_rest=term.cov_rest + _from_turns(term, motion, t[x] - t[y]))


def _from_turns(term: Term, motion: Turned, lever: Array) -> Array:
    """(m, 9) what the uncertain turns of x and y against the base add to the residual's covariance."""
    J = _by_turns(term, lever)
    rows = _rows(term)
    return (J @ motion.cov_turns[np.ix_(rows, rows)] @ np.swapaxes(J, 1, 2)).reshape(-1, 9)


def _by_turns(term: Term, lever: Array) -> Array:
    """Derivative (m, 3, 6) of the residual by the turns of x and of y against the base."""
    length = term.length(term.D @ lever - term.p_x)
    by_x, by_y = se3.skew(term.p_x), -se3.skew(length * term.p_y)
    W = term.D + np.eye(3)
    swing = -se3.skew(W @ lever) + W @ se3.skew(lever)
    parts = [by_x + swing, by_y] if term.turned_by == term.x else [by_x, by_y + swing]
    return np.concatenate(parts, axis=2)


def _rows(term: Term) -> NDArray[np.int64]:
    """Where x's and y's three parameters stand among all."""
    return np.r_[3 * term.x : 3 * term.x + 3, 3 * term.y : 3 * term.y + 3]


def _times(stack: Array, vector: Array) -> Array:
    """(m, a, b) @ (b,) as one matrix-vector product, which is what makes an evaluation fast."""
    return (stack.reshape(-1, len(vector)) @ vector).reshape(stack.shape[:2])


def _kept(t: Array, term: Term, options: TranslationOptions) -> tuple[NDArray[np.int64], Array, Array]:
    """The steps of a term that are not trimmed, the residual's derivative (k, 3, 6) by t, its weight (k, 3, 3)."""
    lever = t[term.x] - t[term.y]
    error, cov = term.residual(lever)
    at = np.flatnonzero(trimmed(log_normal_3d(error, cov), options.trim)[1])
    by_lever = term.jacobians(lever)[0][at]
    return (
        at,
        np.concatenate([by_lever, -by_lever], axis=2),
        np.asarray(0.5 * np.linalg.inv(cov[at]), dtype=np.float64),
    )


def _sums(t: Array, terms: Sequence[Term], options: TranslationOptions) -> delta.Sums:
    sums = delta.Sums.zero(t.size - 3, len(t), len(terms[0].D), 6)
    for term in terms:
        at, by_t, weight = _kept(t, term, options)
        _, E_x, E_y = term.jacobians(t[term.x] - t[term.y])
        J = np.zeros((len(at), 3, t.size))
        J[:, :, _rows(term)] = by_t
        sums.add(at, term.x, term.y, J[:, :, 3:], weight, E_x[at], E_y[at])
    return sums


def _mixed_with_turns(t: Array, terms: Sequence[Term], options: TranslationOptions) -> Array:
    """How the sensors' turns pull at the positions: (3n - 3, 3n)."""
    mixed = np.zeros((t.size, t.size))
    for term in terms:
        at, by_t, weight = _kept(t, term, options)
        by_turns = _by_turns(term, t[term.x] - t[term.y])[at]
        mixed[np.ix_(_rows(term), _rows(term))] += np.einsum("mia,mij,mjb->ab", by_t, weight, by_turns, optimize=True)
    return mixed[3:]
