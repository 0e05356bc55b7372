"""The joint estimator, stage by stage: clocks and turns; what the drive tells of poses; the poses, and how well."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space, orth

from calib_toolkit import assembly, checks, observability, se3, sync
from calib_toolkit.config import Config
from calib_toolkit.errors import NotObservableError
from calib_toolkit.joint import leaning, moving, prior, report, spread, start, told, turning, verdict
from calib_toolkit.joint.clocks import Clocks
from calib_toolkit.joint.readings import ready
from calib_toolkit.progress import Progress
from calib_toolkit.types import Calibration, Measured, Motions, Result, Undetermined

Array = NDArray[np.float64]

STAGES = "clocks, poses"
GATE = 100.0
"""Sigma by which two sensors' angles may differ on a step that is used before their noise is known."""


@dataclass(frozen=True)
class Timed:
    """What the first stage leaves: motions in order, turns, clocks, common steps, and a first guess of the poses T
    (n, 4, 4).
    """

    names: tuple[str, ...]
    motions: list[Motions]
    turned: turning.Turning
    told: told.Told
    steps: sync.Steps
    T: Array

    @property
    def clocks(self) -> Clocks:
        """As far as the drive tells them."""
        return self.told.clocks

    @property
    def unknown(self) -> list[Undetermined]:
        """Clocks that nothing told, in words."""
        return [verdict.clock(name) for name, c in zip(self.names, self.clocks.of, strict=True) if self.told.open[c]]


@dataclass(frozen=True)
class Placed:
    """Poses T (n, 4, 4); cov: (p, p) of ``(dt, delta)`` of each sensor but the base, then of offsets and skews of the
    clocks but the base's; what nothing told, in words; and how it was found, None for sensors without any scale.
    """

    T: Array
    cov: Array
    unknown: list[Undetermined]
    found: moving.Moving | None


def calibrate(motions: Mapping[str, Motions], config: Config, clocks: Sequence[str], progress: Progress) -> Result:
    """All sensors at once. clocks: (n,) sensors that name the same clock share it. Raises CalibrationError."""
    try:
        return _calibrate(motions, config, clocks, progress)
    except np.linalg.LinAlgError as e:
        raise NotObservableError(
            f"the motions of {', '.join(motions)} can not be brought together ({e}); leave out one sensor after the "
            "other to find the one whose motion is wrong"
        ) from e


def _calibrate(motions: Mapping[str, Motions], config: Config, clocks: Sequence[str], progress: Progress) -> Result:
    progress.begin(STAGES, 2)
    if not any(m.has_scale for m in motions.values()):
        prior.without_scale(config.prior)
    timed = _time(motions, clocks, config.prior)
    progress.advance(STAGES, 1)
    turned = _turn(timed)
    placed = _place(timed, config.prior) if timed.steps.has_scale.any() else turned
    progress.advance(STAGES, 1)
    final = _calibration(timed, placed)
    stages = {"timing": _offsets(timed), "rotation": _calibration(timed, turned), "motion": final}
    statistics = report.statistics(final, timed.motions, timed.turned, placed.found, timed.steps, config.prior)
    return Result(final, stages, statistics=statistics)


def clock_offsets(motions: Mapping[str, Motions], config: Config, clocks: Sequence[str]) -> Calibration:
    """The first stage alone. Raises CalibrationError."""
    return _offsets(_time(motions, clocks, config.prior))


def _time(motions: Mapping[str, Motions], clocks: Sequence[str], known: Sequence[Measured]) -> Timed:
    """How late each clock is, whatever the poses."""
    names = tuple(motions)
    prior.checked(known, names)
    checks.moved(motions)
    in_order = [ready(m) for m in motions.values()]
    chains = [sync.chain(m) for m in in_order]
    checks.overlap(names, chains, start.MOST_LATE)
    middle = float(np.mean(chains[0].knots[[0, -1]]))
    first = Clocks.starting(clocks, start.lags(chains), middle)
    steps = _steps(names, chains, first)
    late = prior.late(known, names, first)
    turned = turning.estimate(in_order, start.poses(steps)[:, :3, :3], first, late)
    clocks_told = told.estimate(in_order, turned, late)
    start.agree(names, [c.shifted(d) for c, d in zip(chains, clocks_told.clocks.dt[turned.clocks.of], strict=True)])
    steps = _steps(names, chains, clocks_told.clocks)
    return Timed(names, in_order, turned, clocks_told, steps, start.poses(steps))


def _turn(timed: Timed) -> Placed:
    """The poses as the first stage leaves them: rotations alone."""
    n = len(timed.names)
    q = 2 * (len(timed.clocks) - 1)
    cov = np.zeros((6 * (n - 1) + q, 6 * (n - 1) + q))
    at = (6 * np.arange(n - 1)[:, None] + np.arange(3, 6)).ravel()
    cov[np.ix_(at, at)] = timed.turned.cov[: 3 * (n - 1), : 3 * (n - 1)]
    cov[6 * (n - 1) :, 6 * (n - 1) :] = timed.told.cov
    T = se3.rigid(timed.turned.R_base_sensor, np.zeros((n, 3)))
    open_ = [verdict.turns(directions) for directions in verdict.untold(_unscaled(timed.steps), T)]
    if not timed.steps.has_scale.any() and all(directions.shape[1] == 3 for directions in open_):
        checks.still()
    return Placed(T, cov, _unknown(timed, open_, cov), None)


def _place(timed: Timed, known: Sequence[Measured]) -> Placed:
    """All poses, what nothing tells of them left where it is."""
    names, T = timed.names, timed.T.copy()
    # where nothing is told, noise may have put a sensor anywhere, which would turn the directions that are left
    T[1:] = [verdict.nearest(*both) for both in zip(T[1:], verdict.untold(timed.steps, T), strict=True)]
    open_ = [
        prior.unheld(directions, prior.information(T, names, known)[0][6 * k : 6 * k + 6, 6 * k : 6 * k + 6])
        for k, directions in enumerate(verdict.untold(timed.steps, T))
    ]
    if all(directions.shape[1] == 6 for directions in open_):
        checks.still()
    search = partial(
        moving.estimate,
        timed.motions,
        clocks=timed.clocks,
        turn_scale=timed.turned.scale,
    )
    lean = leaning.stated(timed.motions, timed.turned.R_base_sensor)
    found = search(T=T, free=_free(open_, lean), prior=_prior(names, known, lean))
    ahead = np.sum(timed.steps.vec[0, :, :3], axis=0)
    leans = leaning.axes(timed.turned, lean, open_, verdict.untold(_unscaled(timed.steps), timed.T), found, ahead)
    if any(axes.size for axes in leans):
        lean = lean + leaning.BIASED**2 * block_diag(*(axes @ axes.T for axes in leans))
        found = search(T=found.T_base_sensor, free=_free(open_, lean), prior=_prior(names, known, lean))
    cov, gain = spread.covariance(found.information, found.feigned, found.free)
    cov = cov + leaning.doubt(timed.turned, found, leans, ahead)
    stamps = [timed.clocks.base_time(i, m.start) for i, m in enumerate(timed.motions)]
    groups = np.split(np.arange(6 * (len(names) - 1)), len(names) - 1)
    wider = np.sqrt(spread.inflation(found.pulls, stamps, gain, cov, groups))
    cov = cov * np.outer(wider, wider)
    T, by_found = leaning.between(found, leans)
    # a clock that is off by some time moves the poses with it
    poses, clock_cov = 6 * (len(names) - 1), timed.told.cov
    cov, moved = (by_found @ cov @ by_found.T)[:poses, :poses], (-by_found @ gain @ found.by_clock)[:poses]
    cov = cov + leaning.late(timed.motions, ahead / float(np.sum(np.diff(timed.steps.ends, axis=1))))
    cov = cov + leaning.tilted(timed.motions, timed.turned.R_base_sensor, ahead)
    joint = np.block([[cov + moved @ clock_cov @ moved.T, moved @ clock_cov], [clock_cov @ moved.T, clock_cov]])
    return Placed(T, joint, _unknown(timed, open_, joint), found)


def _unknown(timed: Timed, open_: Sequence[Array], cov: Array) -> list[Undetermined]:
    """Beside the clocks: directions that are open (6, k) of each sensor but the base, and what is known too badly."""
    base, *others = timed.names
    found = [u for name, v in zip(others, open_, strict=True) for u in verdict.in_words(base, name, v)]
    n = len(timed.names)
    poses = np.zeros((n, 6, n, 6))
    poses[1:, :, 1:] = cov[: 6 * (n - 1), : 6 * (n - 1)].reshape(n - 1, 6, n - 1, 6)
    shifts, turns = (poses[:, part, :, part].reshape(3 * n, 3 * n) for part in (slice(3), slice(3, 6)))
    found += observability.vague_turns(timed.names, turns, found)
    return [*found, *observability.vague_shifts(timed.names, shifts, found)]


def _calibration(timed: Timed, placed: Placed) -> Calibration:
    """The poses and clocks as one calibration."""
    n = len(timed.names)
    unknown = [*timed.unknown, *placed.unknown]
    if not timed.steps.has_scale.any():
        unknown += verdict.without_scale(timed.names)
    to_all = np.zeros((7 * n, len(placed.cov)))
    for i in range(1, n):
        to_all[7 * i : 7 * i + 6, 6 * (i - 1) : 6 * i] = np.eye(6)
        if c := int(timed.clocks.of[i]):
            to_all[7 * i + 6, 6 * (n - 1) + c - 1] = 1.0
    known = assembly.determined(timed.names, unknown)
    if placed.found is None:
        known[1:, :3] = False
    return Calibration(
        timed.names[0],
        timed.names,
        placed.T,
        timed.clocks.dt[timed.clocks.of],
        assembly.with_unknown(timed.names, unknown, to_all @ placed.cov @ to_all.T),
        timed.steps.has_scale,
        known,
        tuple(unknown),
        timed.clocks.skew[timed.clocks.of],
        timed.clocks.t_ref,
    )


def _offsets(timed: Timed) -> Calibration:
    """The clocks alone."""
    n = len(timed.names)
    cov = block_diag(np.zeros((6 * (n - 1), 6 * (n - 1))), timed.told.cov)
    found = _calibration(timed, Placed(np.broadcast_to(np.eye(4), (n, 4, 4)), cov, [], None))
    known = found.determined.copy()
    known[1:, 3:6] = False
    return replace(found, determined=known)


def _free(open_: Sequence[Array], lean: Array) -> Array:
    """(9(n-1), k) orthonormal directions in which poses and biases may move. open_: (6, j) of poses, in
    ``verdict.UNITS``. lean: (3(n-1), 3(n-1)) covariance of the biases.
    """
    poses = [null_space((v / verdict.UNITS[:, None]).T) for v in open_]
    return block_diag(*poses, orth(lean))


def _prior(names: Sequence[str], known: Sequence[Measured], lean: Array) -> moving.Prior:
    """Measured numbers, and biases that are zero within their covariance."""
    upright = np.linalg.pinv(lean, hermitian=True)

    def told(T: Array, bias: Array) -> tuple[Array, Array]:
        information, pull = prior.information(T, names, known)
        return block_diag(information, upright), np.concatenate([pull, -upright @ bias[1:].ravel()])

    return told


def _unscaled(steps: sync.Steps) -> sync.Steps:
    """Of which only the turns count."""
    return replace(steps, has_scale=np.zeros(len(steps.has_scale), dtype=bool))


def _steps(names: Sequence[str], chains: Sequence[sync.Chain], clocks: Clocks) -> sync.Steps:
    """Common steps by clocks about right."""
    on_base = [c.shifted(clocks.dt[k]) for c, k in zip(chains, clocks.of, strict=True)]
    checks.overlap(names, on_base, 0.0)
    steps = sync.synchronise(on_base, GATE)
    checks.steps(steps)
    checks.lengths(names, steps)
    return steps
