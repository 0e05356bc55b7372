"""What moves besides the vehicle: cars on the road, people on the pavement, none ever in the vehicle's way."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit_datasets.simulation import props
from calib_toolkit_datasets.simulation.shapes import Array, Mesh
from calib_toolkit_datasets.simulation.site import Site
from calib_toolkit_datasets.simulation.vehicle import TruePath

TICK = 0.1
"""Seconds between the poses of a moving thing; between them it moves straight on."""
VISIBLE = 130.0
"""Metres from the vehicle beyond which nothing moves."""
SUDDEN = 40.0
"""Metres from the vehicle within which no car comes or goes."""
PEDESTRIANS = 4


@dataclass(frozen=True)
class Mover:
    """One moving thing. mesh: index of its shape; poses: (k, 4) of x, y, z and unwrapped yaw, every ``TICK`` seconds
    from ``start``."""

    mesh: int
    tone: float
    start: float
    poses: Array

    def at(self, stamps: Array) -> Array:
        """Poses (n, 4) at stamps within its life."""
        return _between(self.poses, (stamps - self.start) / TICK)

    @property
    def end(self) -> float:
        """Seconds at which it is gone."""
        return self.start + (len(self.poses) - 1) * TICK


def traffic(path: TruePath, site: Site, layout: str) -> tuple[list[Mesh], list[Mover]]:
    """The shapes of everything that moves, and where each is when."""
    rng = site.rng
    shapes = [*(props.car(kind) for kind in props.CARS), *(props.pedestrian(rng) for _ in range(PEDESTRIANS))]
    drive = _Drive(path, site)
    wanted = _walkers(drive, rng, layout)
    if layout in _CARS:
        wanted = [*_CARS[layout](drive, rng), *wanted]
    kept: list[Mover] = []
    for mesh, s, left, way in wanted:
        mover = drive.mover(mesh, s, left, way, float(rng.random()))
        if mover is not None and not any(_meet(mover, other) for other in kept):
            kept.append(mover)
    return shapes, kept


_Wish = tuple[int, Array, float, int]
"""Shape; at every tick, metres along the line that the vehicle drives; metres to its left; 1 along it, -1 against."""
_LENGTH = (4.0, 4.6, 5.0, 7.7)
"""Metres, of each kind of car."""


class _Drive:
    """The vehicle's own progress, every ``TICK`` seconds."""

    def __init__(self, path: TruePath, site: Site) -> None:
        self.site = site
        self.stamps = np.arange(path.stamps[0], path.stamps[-1], TICK)
        self.poses = path.at(self.stamps)
        step = np.linalg.norm(np.diff(self.poses[:, :2, 3], axis=0), axis=1)
        self.s = np.concatenate([[0.0], np.cumsum(step)])

    def mover(self, mesh: int, s: Array, left: float, way: int, tone: float) -> Mover | None:
        """The longest stretch of time for which it can be there, or None: on its line, near, not in the way."""
        main = self.site.main
        x, y, yaw = main.at(s, left).T
        walks = mesh >= len(props.CARS)
        length, ahead, aside = (0.0, 4.0, 2.5) if walks else (_LENGTH[mesh], 6.0, 2.9)
        there = (s > main.s[0]) & (s < main.s[-1])
        for part in (-0.5, 0.0, 0.5):
            at = np.column_stack([x + part * length * np.cos(yaw), y + part * length * np.sin(yaw)])
            u, v = self._beside(at)
            there &= (np.hypot(u, v) < VISIBLE) & ((np.abs(u) > ahead) | (np.abs(v) > aside))
        if walks and self.site.ground.kerb:
            there &= self.site.roads.distance(np.column_stack([x, y])) > self.site.ground.edge + 0.4
        first, last = _longest(there)
        away = np.hypot(*self._beside(np.column_stack([x, y])))
        seen = [k for k in (first, last - 1) if 0 < k < len(s) - 1 and away[k] < SUDDEN]
        if last - first < 2.0 / TICK or (seen and not walks):
            return None
        alive = slice(first, last)
        z = self.site.ground.height(np.column_stack([x, y])[alive])
        facing = yaw[alive] + (np.pi if way < 0 else 0.0)
        return Mover(mesh, tone, float(self.stamps[first]), np.column_stack([x[alive], y[alive], z, facing]))

    def _beside(self, xy: Array) -> tuple[Array, Array]:
        """Metres ahead of the vehicle and to its left, for a place (n, 2) at every tick."""
        forth = self.poses[:, :2, 0] / np.linalg.norm(self.poses[:, :2, 0], axis=1, keepdims=True)
        gap = xy - self.poses[:, :2, 3]
        return np.einsum("ij,ij->i", gap, forth), forth[:, 0] * gap[:, 1] - forth[:, 1] * gap[:, 0]


def _street_cars(drive: _Drive, rng: np.random.Generator) -> list[_Wish]:
    t, wishes = drive.stamps, []
    for meet in np.arange(t[0] - 5.0, t[-1] + 10.0, 5.0):
        meet = meet + rng.uniform(-2.0, 2.0)
        speed = rng.uniform(6.0, 12.0)
        s = np.interp(meet, t, drive.s) - speed * (t - meet)
        wishes.append((int(rng.integers(4)), s, 3.5, -1))
    # one drives ahead and one behind, now nearer, now farther, and both stop where the vehicle does
    for sign, near in ((1, 14.0), (-1, 16.0)):
        gap = near + 12.0 * (1 + np.sin(0.11 * t + rng.uniform(0, 6)))
        wishes.append((int(rng.integers(3)), np.maximum.accumulate(drive.s + sign * gap), 0.0, 1))
    return wishes


def _highway_cars(drive: _Drive, rng: np.random.Generator) -> list[_Wish]:
    t, wishes = drive.stamps, []
    for meet in np.arange(t[0] - 5.0, t[-1] + 10.0, 2.5):
        for left, way, low, high in ((11.0, -1, 20.0, 25.0), (14.5, -1, 26.0, 34.0), (3.5, 1, 2.0, 7.0)):
            at, speed = meet + rng.uniform(-1.0, 1.0), rng.uniform(low, high)
            if way < 0:
                s = np.interp(at, t, drive.s) - speed * (t - at)
            else:
                s = np.maximum.accumulate(drive.s + speed * (t - at))
            if rng.random() < 0.5:
                wishes.append((int(rng.integers(4)), s, left, way))
    gap = 45.0 + 15.0 * np.sin(0.1 * t + rng.uniform(0, 6))
    return [*wishes, (3, np.maximum.accumulate(drive.s + gap), 0.0, 1)]


_CARS = {"street": _street_cars, "highway": _highway_cars}


def _walkers(drive: _Drive, rng: np.random.Generator, layout: str) -> list[_Wish]:
    spacing, lefts = {"street": (16.0, (8.7, -5.2)), "court": (6.0, (4.2, -4.2))}.get(layout, (0.0, ()))
    main, t, wishes = drive.site.main, drive.stamps, []
    for left in lefts:
        for start in np.arange(main.s[0], main.s[-1], spacing):
            way = int(rng.choice([-1, 1]))
            # so that they are spread along the road when the vehicle passes, not when the drive begins
            passes = np.interp(start, drive.s, t)
            s = start + way * rng.uniform(1.0, 1.5) * (t - passes)
            wishes.append((int(rng.integers(PEDESTRIANS)) + len(props.CARS), s, left + rng.uniform(-0.4, 0.4), way))
    return wishes


def _longest(there: NDArray[np.bool_]) -> tuple[int, int]:
    """Start and stop of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    if not len(edges):
        return 0, 0
    runs = edges.reshape(-1, 2)
    start, stop = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(start), int(stop)


def _meet(a: Mover, b: Mover) -> bool:
    """Whether two would drive or walk through each other."""
    shared = np.arange(max(a.start, b.start), min(a.end, b.end), TICK)
    near = 8.0 if max(a.mesh, b.mesh) < len(props.CARS) else 2.4
    if not len(shared):
        return False
    gap = a.at(shared)[:, :2] - b.at(shared)[:, :2]
    heading = a.at(shared)[:, 3]
    ahead = np.abs(gap[:, 0] * np.cos(heading) + gap[:, 1] * np.sin(heading))
    aside = np.abs(gap[:, 1] * np.cos(heading) - gap[:, 0] * np.sin(heading))
    return bool(np.any((ahead < near) & (aside < 2.4 if near > 3 else aside < 0.7)))


def _between(table: Array, index: Array) -> Array:
    low = np.clip(np.floor(index).astype(int), 0, len(table) - 2)
    part = (index - low)[:, None]
    return (1 - part) * table[low] + part * table[low + 1]
