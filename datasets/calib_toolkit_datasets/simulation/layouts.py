"""The kinds of places that a drive can lead through, and the furnishing of one of them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calib_toolkit_datasets.simulation import country, court, props, street
from calib_toolkit_datasets.simulation.buildings import barn, block
from calib_toolkit_datasets.simulation.ground import Array, Ground, Paint, waves
from calib_toolkit_datasets.simulation.road import Line, Roads, along, side_street
from calib_toolkit_datasets.simulation.site import Site
from calib_toolkit_datasets.simulation.terrain import Terrain
from calib_toolkit_datasets.simulation.vehicle import TruePath


@dataclass(frozen=True)
class Layout:
    """One kind of place.

    shift: metres from the vehicle's line to the left, to the middle of its carriageway. extension: metres by which
    roads go on beyond the drive. edge, kerb, bank, hill and finest: see ``Ground``.
    """

    furnish: Callable[[Site], None]
    shift: float
    extension: float
    edge: float
    kerb: float = 0.0
    bank: float = 0.0
    hill: float = 14.0
    finest: int = 6


LAYOUTS = {
    "street": Layout(street.furnish, 1.75, 120.0, street.EDGE, kerb=0.12),
    "court": Layout(court.furnish, 0.0, 0.0, 2.0, hill=6.0),
    "highway": Layout(country.highway, 1.75, 240.0, country.HIGHWAY_EDGE, bank=3.0, hill=20.0, finest=5),
    "open": Layout(country.fields, 1.3, 200.0, country.LANE_EDGE, hill=8.0, finest=5),
}


def furnished(path: TruePath, ground: Terrain, name: str, seed: int) -> Site:
    """The place that a path leads through, with everything that does not move."""
    layout = LAYOUTS[name]
    rng = np.random.default_rng([seed, 2])
    main = along(path, layout.extension)
    lines = [main.offset(layout.shift)]
    if name == "highway":
        lines.append(main.offset(layout.shift + 12.8))
    driven = cKDTree(main.xy)
    if name == "street":
        lines += _side_streets(lines[0], rng)
    roads = Roads(lines, driven)
    high = waves(rng, 90.0, 260.0)
    surface = Ground(ground, roads, layout.edge, layout.kerb, layout.bank, layout.hill, high, layout.finest)
    site = Site(main, roads, surface, rng)
    layout.furnish(site)
    _far_away(site, name)
    site.meshes.append(surface.mesh(_paints(site, name)))
    return site


def _side_streets(line: Line, rng: np.random.Generator) -> list[Line]:
    """Side streets every hundred metres or so, where there is room for them."""
    tree, found = cKDTree(line.xy), []
    for s in np.arange(line.s[0] + rng.uniform(30, 60), line.s[-1] - 30, 130.0):
        street_ = side_street(line, s + rng.uniform(-15, 15), int(rng.choice([-1, 1])), 40.0)
        if np.all(tree.query(street_.xy)[0] > np.minimum(street_.s, 25.0) - 2.0):
            found.append(street_)
    return found


def _far_away(site: Site, name: str) -> None:
    """Trees, houses and blocks on the horizon; coarse, since nobody comes near."""
    rng = site.rng
    clumps = [props.grove(rng) for _ in range(4)]
    site.stand(clumps, site.scatter(40.0, 75.0, 280.0, 0.22), (14.0, 8.0), 70.0, stretch=0.3)
    if name in ("street", "court"):
        houses = [barn(14, 10, h, m, rng) for h, m in ((6, "plaster"), (9, "brick"), (7, "plaster"))]
        for place in site.scatter(22.0, 34.0, 100.0, 0.5):
            if site.free(place[None], (14, 10), 30.0, 5.0)[0]:
                site.put_level(houses[rng.integers(3)], place[None])
    if name != "open":
        blocks = [block(22, 14, h, "concrete") for h in (20.0, 30.0, 42.0)]
        for place in site.scatter(90.0, 130.0, 280.0, 0.25):
            if site.free(place[None], (22, 14), 120.0, 7.0)[0]:
                site.put_level(blocks[rng.integers(3)], place[None])


def _paints(site: Site, name: str) -> list[Paint]:
    """What the ground is made of, in the order in which it is laid."""
    roads, rng, edge = site.roads, site.rng, site.ground.edge
    bare = waves(rng, 15.0, 70.0)

    def within(reach: float) -> Callable[[Array], Array]:
        return lambda xy: reach - roads.distance(xy)

    if name == "court":
        low, high = court.extent(site.main.xy)
        fine = waves(rng, 5.0, 25.0)
        return [
            Paint("earth", lambda xy: fine.height(xy) + 0.25),
            Paint("pavement", lambda xy: 3.0 - np.abs(np.min(np.minimum(xy - low, high - xy), axis=1))),
        ]
    if name == "street":
        walk = [Paint("pavement", within(street.WALK)), Paint("kerb", within(edge + 0.15))]
        return [Paint("earth", lambda xy: bare.height(xy) - 0.6), *walk, Paint("asphalt", within(edge))]
    verge = Paint("earth", within(edge + 1.2))
    return [Paint("earth", lambda xy: bare.height(xy) - 0.1), verge, Paint("asphalt", within(edge))]
