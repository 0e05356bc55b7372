"""A place that is being furnished: its roads, its ground, what is still free, and all that stands there so far."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib_toolkit_datasets.simulation.ground import Ground
from calib_toolkit_datasets.simulation.road import Line, Plots, Roads
from calib_toolkit_datasets.simulation.shapes import Mesh, place

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Site:
    """What layouts work on. main: the line that the vehicle drives."""

    main: Line
    roads: Roads
    ground: Ground
    rng: np.random.Generator
    meshes: list[Mesh] = field(default_factory=list)
    plots: Plots = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "plots", Plots(self.roads))

    def stand(
        self,
        choices: Sequence[Mesh],
        places: Array,
        size: tuple[float, float],
        apart: float,
        stretch: float = 0.0,
        run: bool = False,
    ) -> None:
        """Puts one of the choices at each place (k, 3) that is free.

        size, apart: what ``free`` takes; stretch, run: what ``put`` takes.
        """
        self.put(choices, places[self.free(places, size, apart)], stretch, run)

    def free(self, places: Array, size: tuple[float, float], apart: float, depth: float = 0.0) -> NDArray[np.bool_]:
        """Which places (k, 3) were free for a rectangle of ``size`` until now; see ``Plots.claim``.

        depth: metres by which the middle of the rectangle lies behind the place.
        """
        behind = np.column_stack([-np.sin(places[:, 2]), np.cos(places[:, 2]), 0 * places[:, 2]])
        return self.plots.claim(places + depth * behind, size, apart)

    def put(self, choices: Sequence[Mesh], places: Array, stretch: float = 0.0, run: bool = False) -> None:
        """Puts one of the choices at each place (k, 3), on the slope of the ground, with a tone of its own.

        stretch: share by which sizes vary. run: whether all are pieces of one long thing, in one tone.
        """
        which = self.rng.integers(len(choices), size=len(places))
        tone = np.full(len(places), self.rng.random()) if run else self.rng.random(len(places))
        factor = 1 + stretch * self.rng.uniform(-1, 1, (len(places), 1)) * np.ones(3)
        pose = np.column_stack([places[:, :2], self.ground.height(places[:, :2]), places[:, 2]])
        heading = np.column_stack([np.cos(places[:, 2]), np.sin(places[:, 2])])
        slope = np.einsum("ij,ij->i", self.ground.terrain.gradient(places[:, :2]), heading)
        for k, mesh in enumerate(choices):
            mine = which == k
            if mine.any():
                self.meshes.append(place(mesh, pose[mine], tone[mine], factor[mine], slope[mine]))

    def put_level(self, mesh: Mesh, place_: Array) -> None:
        """Puts a building at a place (1, 3), upright whatever the slope."""
        z = self.ground.height(place_[:, :2])
        pose = np.column_stack([place_[:, :2], z, place_[:, 2]])
        self.meshes.append(place(mesh, pose, self.rng.random()))

    def every(self, line: Line, spacing: float, left: float, jitter: float = 0.3, share: float = 1.0) -> Array:
        """Places (k, 3) beside a line, ``spacing`` metres apart, unevenly by a share of it; some are left out."""
        s = np.arange(line.s[0] + self.rng.uniform(0, spacing), line.s[-1], spacing)
        s = s + self.rng.uniform(-jitter, jitter, len(s)) * spacing
        return line.at(s[self.rng.random(len(s)) < share], left)

    def scatter(self, spacing: float, nearest: float, farthest: float, share: float = 1.0) -> Array:
        """Places (k, 3) anywhere between two distances from the nearest road, facing anywhere."""
        xy = np.concatenate([line.xy for line in self.roads.lines])
        low, high = xy.min(axis=0) - farthest, xy.max(axis=0) + farthest
        grid = np.meshgrid(*(np.arange(a, b, spacing) for a, b in zip(low, high, strict=True)))
        at = np.column_stack([g.reshape(-1) for g in grid])
        at = at + self.rng.uniform(-0.45, 0.45, at.shape) * spacing
        distance = self.roads.distance(at)
        kept = (distance > nearest) & (distance < farthest) & (self.rng.random(len(at)) < share)
        return np.column_stack([at[kept], self.rng.uniform(-np.pi, np.pi, int(kept.sum()))])


def turned(places: Array, by: float) -> Array:
    """The same places facing another way, by an angle in radians."""
    return places + np.array([0.0, 0.0, by])
