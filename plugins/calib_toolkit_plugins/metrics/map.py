"""``map``: where a lidar must sit for its scans to fall together along the path of another sensor.

Along the right mount, walls and ground that are seen twice lie on each other; along a wrong one they part wherever
the vehicle turns, rolls or pitches. For a lidar and a pose sensor (INS, odometry) scans a fraction of a second apart
are laid along the sensor's path; of two lidars, the scans of the second on those that the first took a little earlier
and later, so that they need not look the same way. Ours, not the paper's.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import NoOptions, Pair, PairEstimate, Transform, hookimpl, se3
from calib_toolkit_plugins.metrics.map_links import Problem, problem_of
from calib_toolkit_plugins.metrics.map_scans import Patch, Sweep, covered, misfit, read_sweep, straighten
from calib_toolkit_plugins.metrics.map_solve import LATE, Equations, State, equations, freed, moved, steadied, stepped

Array = NDArray[np.float64]

GATES = (1.5, 1.0, 0.5, 0.3)
"""Metres within which points must find a surface, from the first match to the last ones."""
ROUNDS = 30
ENOUGH = 0.1
"""Sigmas: a smaller step than this ends the search."""
SHORTEST = 0.125
"""Of a step, the least part that is taken."""
FIRST_RUNS = 8
"""Runs of scans that find the mount along which all others are straightened; with fewer in all, none is found."""
START = np.repeat([0.02, np.radians(0.1)], 3)
"""What a path's errors over one second are taken for at first (metres, radians)."""
FEIGNED = 0.5
"""Share of the information along a direction that noise may feign; with more, it is not seen."""
LEFT = 0.1
"""Of the information, at least this share is taken to remain without any one run."""
UNSEEN, FAR = 10.0, 10.0
"""Sigma of what is not seen, metres; a rotation counts as what it moves at the distance ``FAR``."""
MATCHING = np.repeat([1e-3, np.radians(0.01)], 3)
"""Sigma of what matching errs in all scans alike (metres, radians): no number of runs averages it away."""
TOGETHER = 8.0
"""Seconds within which runs have errors in common: scans, or the path between them."""
FEWEST = 3.0
"""Degrees of freedom, at least: with two, a variance has no end."""
SHARED = 0.1
"""Share of the points of one lidar that must find surfaces of the other."""

Surfaces = Mapping[tuple[str, int], Patch]


class Map:
    """The metric: accepts a lidar with a pose sensor in either order, and two lidars."""

    id = "map"
    options: type = NoOptions
    version = "8"

    def accepts(self, kind_a: str, kind_b: str) -> bool:
        """Whether one is a lidar, and the other a lidar or a sensor of poses."""
        kinds = {kind_a, kind_b}
        return "velodyne" in kinds and kinds <= {"velodyne", "gps_ins", "odometry"}

    def overlap(self, pair: Pair) -> bool:
        """Whether scans can be laid on each other: one lidar's own always, two lidars' where a tenth of the points
        finds a surface of the other, now or a few seconds away."""
        if not len(pair) or pair.a.kind != pair.b.kind:
            return len(pair) > 0
        problem = problem_of(replace(pair, selected=pair.selected[:: -(-len(pair) // 4)]))
        surfaces = _surfaces(problem, {}, problem.T)
        state = State(problem.T, np.zeros((len(problem.links), 6)), START**2)
        return any(
            covered(surfaces[a], surfaces[b], T, GATES[1]) > SHARED
            for (a, b), T in zip(problem.scans(), state.targets_sources(problem.links), strict=True)
            if a in surfaces and b in surfaces
        )

    def estimate(self, pair: Pair, options: NoOptions) -> PairEstimate:
        """``T_a_b`` by Gauss-Newton on the distances of points from surfaces, the path's own errors eliminated.

        The covariance is that of the jackknife over runs of scans, and so covers errors of any kind that runs do not
        share, and what an INS states of its attitude. Raises DataError for a reading that is no scan.
        """
        problem = problem_of(pair)
        runs = np.unique(problem.links.group)
        if len(runs) < FIRST_RUNS:
            return _refused(pair, f"scans can be compared in {len(runs)} places only, and it takes {FIRST_RUNS}")
        sweeps: dict[tuple[str, int], Sweep | None] = {}
        first = problem[np.isin(problem.links.group, runs[:: len(runs) // FIRST_RUNS])]
        start = State(problem.T, np.zeros((len(first.links), 6)), START**2)
        surfaces = _surfaces(first, sweeps, problem.T)
        if not surfaces:
            return _refused(pair, "none of the scans compared holds enough points")
        few = _search(first, surfaces, start, GATES)
        start = State(few[0].T, np.zeros((len(problem.links), 6)), few[0].variance)
        del surfaces  # before the next are made: they are large
        surfaces = _surfaces(problem, sweeps, start.T)
        sweeps.clear()
        state, found, settled, rms = _search(problem, surfaces, start, GATES[-1:])
        shown = int(found.shares.any(axis=(1, 2)).sum())
        if shown < FIRST_RUNS:
            return _refused(pair, f"scans have surfaces in common in {shown} places only, and it takes {FIRST_RUNS}")
        T, cov = _without_prior(problem, state, found)
        late = replace(problem, links=replace(problem.links, T_path=problem.links.T_late))
        # a clock errs by a tenth of LATE or so: here a search that comes to no rest is near enough
        T_late, _ = _without_prior(late, *_search(late, surfaces, state, GATES[-1:])[:2])
        by_clock = _step(T, T_late) / LATE
        if problem.inverted:
            J = se3.relative_jacobians(T, np.eye(4))[0]
            T, cov, by_clock = se3.invert(T), J @ cov @ J.T, J @ by_clock
        transform = Transform(pair.a.name, pair.b.name, T, (cov + cov.T) / 2)
        note = "" if settled else f"its search did not come to rest within {ROUNDS} rounds"
        statistics = {"runs": float(shown), "links": float(len(problem.links)), "rms": rms}
        return PairEstimate("map", transform, by_clock, settled, note, statistics)


@hookimpl
def calib_register_metrics() -> list[Map]:
    """The ``map`` metric."""
    return [Map()]


def _surfaces(problem: Problem, sweeps: dict[tuple[str, int], Sweep | None], T_path_lidar: Array) -> Surfaces:
    """The surfaces of all scans of a problem, straightened along the path; ``sweeps`` keeps what has been read."""
    made = {}
    for key in sorted({key for link in problem.scans() for key in link}):
        track = problem.track(key[0])
        if key not in sweeps:
            sweeps[key] = read_sweep(track, key[1])
        sweep = sweeps[key]
        found = (
            None if sweep is None else straighten(sweep, problem.motion, np.eye(4) if track.fixed else T_path_lidar)
        )
        if found is not None:
            made[key] = found
    return made


def _search(
    problem: Problem, surfaces: Surfaces, state: State, gates: Iterable[float]
) -> tuple[State, Equations, bool, float]:
    """Matches points and steps in turn, until steps are small; and whether they became so.

    The motion stage's mount steers along what is hardly seen. Points that change their match back and forth would
    turn steps round for ever, so from the first that goes back on they are half as long, and so on down to the
    ``SHORTEST``, with which it is enough that they are short. Returns the last state whose equations are known,
    those equations without the motion's prior on the mount, whether steps became small, and ``_misfits``' distance.
    """
    gates, before, length, last = list(gates), np.zeros(6), 1.0, state
    prior = np.linalg.inv(problem.cov)
    for round_ in range(ROUNDS):
        information, gradient, rms = _misfits(problem, surfaces, state, gates[min(round_, len(gates) - 1)])
        found = equations(state, problem.links, information, gradient)
        steered = found.information + prior
        step = np.asarray(-np.linalg.solve(steered, found.gradient + prior @ _step(problem.T, state.T)), dtype=float)
        if round_ >= len(gates) and step @ steered @ before < 0:
            length = max(length / 2, SHORTEST)
        before, step = step, length * step
        told = step if length == SHORTEST else before
        if round_ >= len(gates) + 1 and told @ steered @ told < ENOUGH**2:
            return state, found, True, rms
        last, state = state, moved(state, problem.links, found, step)
    return last, found, False, rms


def _misfits(problem: Problem, surfaces: Surfaces, state: State, gate: float) -> tuple[Array, Array, float]:
    """``Misfit`` of every link, zero where two scans share nothing, and the links' median distance (rms), metres."""
    information, gradient = np.zeros((len(problem.links), 6, 6)), np.zeros((len(problem.links), 6))
    rms = []
    for i, ((a, b), T) in enumerate(zip(problem.scans(), state.targets_sources(problem.links), strict=True)):
        found = misfit(surfaces[a], surfaces[b], T, gate) if a in surfaces and b in surfaces else None
        if found is not None:
            information[i], gradient[i] = found.information, found.gradient
            rms.append(found.rms)
    return information, gradient, float(np.median(rms)) if rms else np.nan


def _step(T_from: Array, T_to: Array) -> Array:
    """``(dt, delta)`` from one mount to another."""
    return np.concatenate([T_to[:3, 3] - T_from[:3, 3], se3.log_so3(T_to[:3, :3] @ T_from[:3, :3].T)])


def _without_prior(problem: Problem, state: State, found: Equations) -> tuple[Array, Array]:
    """``T_path_lidar`` and its covariance from the residuals alone: a last step, without the prior, along what is
    seen."""
    found = freed(found, state.T) if problem.links.one_mount else steadied(found)
    seen, kept, unseen = _directions(found)
    T = stepped(state.T, -seen / kept @ seen.T @ found.gradient)
    turned = np.vstack([-se3.skew(T[:3, 3]), np.eye(3)])
    lasting = turned @ problem.attitude @ turned.T + np.diag(MATCHING**2)
    return T, _jackknife(found, seen, kept) + UNSEEN**2 * unseen @ unseen.T + lasting


def _directions(found: Equations) -> tuple[Array, Array, Array]:
    """Directions that are seen, (6, m), each with one sigma of information, and the part of it, (m,), that noise does
    not feign; and those not seen, (6, 6 - m), of length one where a rotation counts at the distance ``FAR``."""
    least = np.diag(np.repeat([UNSEEN**-2, (UNSEEN / FAR) ** -2], 3))
    variance, axes = np.linalg.eigh(found.information + least)
    whiten = axes / np.sqrt(variance)
    feigned, turn = np.linalg.eigh(whiten.T @ (found.feigned + least) @ whiten)
    directions, seen = whiten @ turn, feigned < FEIGNED
    length = np.linalg.norm(directions * np.repeat([1.0, FAR], 3)[:, None], axis=0)
    return directions[:, seen], 1 - feigned[seen], (directions / length)[:, ~seen]


def _jackknife(found: Equations, seen: Array, kept: Array) -> Array:
    """Covariance (6, 6) from how far the estimate moves when one run of scans is left out (Efron, 1982).

    A single turn may tell nearly all of a lever arm; the plain spread of the gradients then promises too much.
    Runs that are near in time err alike (Bartlett's weights; Newey & West, 1987). Along no direction is it taken to
    be less than if every link erred on its own, which so few runs may feign; and a variance told by few runs is wide
    itself: the estimate follows Student's t, with 1.5 degrees of freedom for each stretch of runs that err alike.
    """
    without = np.diag(kept) - seen.T @ found.shares @ seen
    slopes = found.slopes - found.slopes.mean(axis=0)
    left, axes = np.linalg.eigh(without)
    inverse = axes / np.maximum(left, LEFT)[:, None] @ np.swapaxes(axes, 1, 2)
    moves = np.einsum("nij,nj->ni", inverse, slopes @ seen) * np.sqrt(kept)
    alike = np.maximum(1 - np.abs(found.when[:, None] - found.when) / TOGETHER, 0.0)
    # the mean was taken out, which hides a part of what all have in common
    stretches = len(moves) ** 2 / alike.sum()
    variance, axes = np.linalg.eigh(moves.T @ alike @ moves / max(1 - 1 / stretches, LEFT))
    axes = seen / np.sqrt(kept) @ axes
    freedom = max(1.5 * stretches, FEWEST)
    return np.asarray(axes * np.maximum(variance, 1.0) @ axes.T) * freedom / (freedom - 2)


def _refused(pair: Pair, note: str) -> PairEstimate:
    """No estimate: the prior's transform, so wide that it says nothing."""
    cov = np.diag(np.repeat([UNSEEN, UNSEEN / FAR], 3) ** 2)
    return PairEstimate("map", replace(pair.prior, cov=cov), converged=False, note=note)
