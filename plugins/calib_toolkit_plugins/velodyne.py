"""Spinning lidar: motion by registration of successive sweeps (paper, section V-A)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import DataError, Motions, Sensor, Stream, hookimpl, se3
from calib_toolkit_plugins import registration, world_frame
from calib_toolkit_plugins.deskewing import derivatives, deskew, settled
from calib_toolkit_plugins.registration import Surface
from calib_toolkit_plugins.scan_tables import open_table

Array = NDArray[np.float64]

LEAN = float(np.radians(0.02))
"""By which a lidar's own calibration, and surfaces seen at a slant, turn its travel."""
LATE = 0.01
"""Of a sweep, by which motion seems late: what is seen ahead is not seen when what is seen behind is, so that the
instant at which a sweep shows roll and pitch depends on where there is something to see."""
ASIDE = 0.2
"""Of the time from the stamp to the middle of what is seen: so far a motion within a tenth of a second is known."""
LOCAL = 50_000
"""Cells, about, of the last sweeps, on which the next one is laid: with few beams most of the ground lies between
the rings of a single sweep, and rings that lie on rings hide half of all roll and pitch."""
COARSER, COARSE_LOCAL, COARSE_POINTS = 2, 12_000, 30_000
"""How many times larger the cells of the coarse passes are, how many cells they lay a sweep on, and how many of its
points they look at, about."""


@dataclass(frozen=True)
class VelodyneOptions:
    """How sweeps are registered; lengths in metres.

    min_range, max_range: points outside are dropped (the vehicle itself; beams too far apart).
    cell: one point is kept of each cell of this size. gate: farthest match at the end, and largest
    point-to-plane residual (the paper's 0.2 m).
    range_sigma: noise along the beam from which the covariance follows (the paper's 0.1 m).
    max_jump: how far a step may be from what was foreseen (in the first pass the step before it); also the sigma
    of what the surroundings do not show. min_overlap: share of a sweep that must lie on the surfaces of the last
    few. min_points: with fewer left of it, a sweep is not used. deskew: move points to where the scanner was at the
    stamp. point_to_plane: answer with the paper's point-to-plane minimum instead of the plane-to-plane one, settled
    within the sweep.
    """

    min_range: float = 2.0
    max_range: float = 100.0
    cell: float = 0.25
    gate: float = 0.2
    range_sigma: float = 0.1
    max_jump: float = 3.0
    min_overlap: float = 0.5
    min_points: int = 200
    deskew: bool = True
    point_to_plane: bool = False


@hookimpl
def calib_register_sensors() -> list[Sensor]:
    """The ``velodyne`` sensor."""
    return [Sensor(id="velodyne", estimate=estimate, options=VelodyneOptions, open_table=open_table, version="13")]


def estimate(stream: Stream, options: VelodyneOptions) -> Motions:
    """``T_prev_curr`` between the stamps of successive ``Scan`` readings, with the covariance of range noise.

    Each sweep is laid on the last few. In the first pass, a coarse one, the previous motion is the first guess and
    moves the points of a sweep to its stamp, as in the paper. But roll and pitch change within a sweep, which would
    hide some hundredths of them: the other two, coarse and fine, move the points as the steps before and after say,
    changes of the turn rate included, and the last finds what else the vehicle shook (:mod:`deskewing`).
    Without times of points there are two passes, both fine, and no point is moved. A step that fails (too few
    points, too little overlap, a jump) is left out.
    Raises DataError with fewer than two readings, or one that is not a scan.
    """
    if len(stream) < 2:
        raise DataError(f"sensor {stream.name}: a motion takes two scans, and there are {len(stream)}")
    fine = _Pass(options, LOCAL, shakes=not options.point_to_plane)
    timed = options.deskew and getattr(stream.readings[0], "times", None) is not None
    coarse = _Pass(replace(options, cell=COARSER * options.cell), COARSE_LOCAL, COARSE_POINTS) if timed else fine
    steps = _checked(stream, options, *_first_pass(stream, coarse))
    if timed:
        steps = _again(stream, coarse, steps)
    return _motions(stream, _again(stream, fine, steps))


@dataclass(frozen=True)
class _Pass:
    """How closely sweeps are looked at. local: cells of the last ones on which the next is laid. points: about as
    many of each are taken; all by default. shakes: whether to look for motion within a sweep that the steps around
    it do not show."""

    options: VelodyneOptions
    local: int
    points: int | None = None
    shakes: bool = False


@dataclass(frozen=True)
class _Sweep:
    """The usable points of a scan, each as measured."""

    points: Array
    times: Array | None
    options: VelodyneOptions
    seen: Array

    @staticmethod
    def read(stream: Stream, k: int, how: _Pass) -> "_Sweep":
        scan, options = stream.readings[k], how.options
        where = f"sensor {stream.name}, scan {k} (stamp {stream.stamps[k]:.6f} s)"
        points = np.asarray(getattr(scan, "points", None), dtype=np.float64)
        times = None if getattr(scan, "times", None) is None else np.asarray(scan.times, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise DataError(f"{where}: a velodyne reads Scans of (n, 3) points, not {type(scan).__name__}")
        if times is not None and times.shape != points.shape[:1]:
            raise DataError(f"{where}: {times.size} times for {len(points)} points; each point needs one or none")
        squared = np.einsum("ij,ij->i", points, points)
        usable = (squared > options.min_range**2) & (squared < options.max_range**2)  # False for nan
        if times is not None:
            usable &= np.isfinite(times)
            times = times[usable]
        seen, points = world_frame.middle_and_nearest(points), points[usable]
        # an odd step meets all beams of an even number
        step = len(points) // how.points | 1 if how.points else 1
        return _Sweep(points[::step], times[::step] if options.deskew and times is not None else None, options, seen)

    @property
    def enough(self) -> bool:
        return len(self.points) >= self.options.min_points

    def straight(self, velocity: Array | None, change: Array | None = None) -> "_Sweep":
        """With all points moved to the stamp; velocity and its change as :func:`deskewing.deskew` takes them."""
        if velocity is None or self.times is None or np.isnan(velocity[0]):
            return self
        return replace(self, points=deskew(self.points, self.times, velocity, change))

    @property
    def surface(self) -> Surface:
        return registration.surface(self.points, self.options.cell)

    @property
    def thinned(self) -> Array:
        return registration.thinned(self.points, self.options.cell)


_Step = tuple[Array, Array] | None
"""``T_prev_curr`` and its covariance; None where it failed."""


def _checked(stream: Stream, options: VelodyneOptions, steps: list[_Step], seen: Array) -> list[_Step]:
    """The steps, unless the clouds were moved to a world frame. seen: (n, 4) of the scans."""
    travelled = sum(float(np.linalg.norm(step[0][:3, 3])) for step in steps if step is not None)
    world_frame.refuse_moved(stream, seen, travelled, options.max_range)
    return steps


def _first_pass(stream: Stream, how: _Pass) -> tuple[list[_Step], Array]:
    """Every step from the motion before it; from nothing at the start and after a step that failed.

    And where each scan lies, (n, 4), as :mod:`~calib_toolkit_plugins.world_frame` wants it.
    """
    options, steps = how.options, list[_Step]()
    prev, velocity = _Sweep.read(stream, 0, how), None
    last: list[Array] = []  # the newest first, all where the scanner was at its stamp
    seen = [prev.seen]
    for k in range(1, len(stream)):
        curr, dt = _Sweep.read(stream, k, how), float(stream.stamps[k] - stream.stamps[k - 1])
        seed = None if velocity is None else se3.matrix(velocity * dt)
        if seed is None and prev.enough and curr.enough:
            seed = _from_nothing(stream, k, options)
            velocity = se3.vector(seed) / dt
        step = None
        if prev.enough and curr.enough and seed is not None:
            last = last or [prev.straight(velocity).thinned]
            step, points = _laid(last, curr.straight(velocity), seed, how)
        velocity = None if step is None else se3.vector(step[0]) / dt
        last = [] if step is None else _enough([points, *_moved(last, se3.invert(step[0]))], how.local)
        steps.append(step)
        prev = curr
        seen.append(curr.seen)
    return steps, np.array(seen)


def _from_nothing(stream: Stream, k: int, options: VelodyneOptions) -> Array:
    """``T_prev_curr`` (4, 4) of the step to sweep k where nothing is foreseen, from all points."""
    prev, curr = (_Sweep.read(stream, i, _Pass(options, 0)).surface for i in (k - 1, k))
    return registration.register(prev, curr, np.eye(4), registration.FAR_LEVELS, options.gate)


def _again(stream: Stream, how: _Pass, first: list[_Step]) -> list[_Step]:
    """The steps once more, sweeps straightened by them: each on the last ones; or, where there are not enough of
    those yet, the sweep before on the next ones."""
    moving = [*zip(*derivatives(stream.stamps, [None if s is None else s[0] for s in first]), strict=True)]

    def seen(k: int) -> _Sweep:
        return _Sweep.read(stream, k, how).straight(*moving[k])

    steps, early = list(first), []
    last: list[Array] = []  # the newest first, all where the scanner was at its stamp
    for k, seed in enumerate(first):
        if seed is None:
            last = []
            continue
        last = last or [seen(k).thinned]
        if sum(map(len, last)) < how.local:
            early.append(k)
        steps[k], points = _laid(last, seen(k + 1), seed[0], how)
        step = steps[k]
        last = [] if step is None else _enough([points, *_moved(last, se3.invert(step[0]))], how.local)
    for k in reversed(early):
        if (step := steps[k]) is not None:
            later, T = [seen(k + 1).thinned], np.eye(4)
            for i in range(k + 1, len(steps)):
                if (after := steps[i]) is None or sum(map(len, later)) >= how.local:
                    break
                T = T @ after[0]
                later += _moved([seen(i + 1).thinned], T)
            back = _laid(later, seen(k), se3.invert(step[0]), how)[0] if len(later) > 1 else None
            steps[k] = step if back is None else _inverse(*back)
    return steps


def _laid(clouds: Sequence[Array], sweep: _Sweep, T_seed: Array, how: _Pass) -> tuple[_Step, Array]:
    """The step from the frame of the clouds to a sweep's, and points (m, 3) of the sweep.

    Its covariance is always that of the pose alone, before what shook within the sweep is looked for.
    """
    options = how.options
    onto, curr = registration.surface(np.concatenate(clouds), options.cell), sweep.surface
    step = _step(onto, curr, T_seed, options)
    if step is None or sweep.times is None or not how.shakes:
        return step, curr.points
    T, points = settled(onto, sweep.points, sweep.times, step[0], options.cell, options.gate)
    return (T, step[1]), points


def _enough(clouds: list[Array], cells: int) -> list[Array]:
    """The first clouds, as many as make a local map."""
    total = np.cumsum([len(c) for c in clouds])
    return clouds[: int(np.searchsorted(total, cells)) + 1]


def _inverse(T: Array, cov: Array) -> tuple[Array, Array]:
    """A motion the other way round, with the covariance (6, 6) of its ``vec``."""
    back = se3.invert(T)
    J = np.linalg.inv(se3.vec_jacobian(se3.vector(back))) @ se3.relative_jacobians(T, np.eye(4))[0]
    J = J @ se3.vec_jacobian(se3.vector(T))
    return back, J @ cov @ J.T


def _moved(clouds: Sequence[Array], T: Array) -> list[Array]:
    return [p @ T[:3, :3].T + T[:3, 3] for p in clouds]


def _step(prev: Surface, curr: Surface, T_seed: Array, options: VelodyneOptions) -> _Step:
    T = registration.register(prev, curr, T_seed, registration.NEAR_LEVELS, options.gate)
    if options.point_to_plane:
        T = registration.point_to_plane(prev, curr, T, options.gate)
    if np.linalg.norm(T[:3, 3] - T_seed[:3, 3]) > options.max_jump:
        return None
    residuals = registration.plane_residuals(prev, curr.points, T, options.gate)
    if residuals.overlap < options.min_overlap or len(residuals.errors) < options.min_points:
        return None
    cov = registration.range_covariance(residuals, options.range_sigma, options.max_jump)
    return (T, cov) if np.all(np.isfinite(T)) and np.all(np.isfinite(cov)) else None


def _motions(stream: Stream, steps: Sequence[_Step]) -> Motions:
    found = [(k, *step) for k, step in enumerate(steps) if step is not None]
    if not found:
        return Motions(np.zeros(0), np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6, 6)))
    k, T, cov = (np.array(column) for column in zip(*found, strict=True))
    start, end = stream.stamps[k], stream.stamps[k + 1]
    return Motions(start, end, se3.vector(T), cov, lean=np.full(3, LEAN), late=_late(stream))


def _late(stream: Stream) -> float:
    """Seconds by which the motion may seem late, as a few scans show."""
    looked = (stream.readings[int(k)] for k in np.linspace(0, len(stream) - 1, 5))
    aside = [float(np.nanmean(s.times)) for s in looked if s.times is not None and len(s.times)]
    return float(np.hypot(LATE * stream.period, ASIDE * np.mean(aside))) if aside else LATE * stream.period
