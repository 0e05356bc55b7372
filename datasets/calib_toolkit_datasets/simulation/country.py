"""Outside towns: a highway between guard rails, and open fields with little to see."""

import numpy as np

from calib_toolkit_datasets.simulation import props
from calib_toolkit_datasets.simulation.buildings import barn
from calib_toolkit_datasets.simulation.ground import Array
from calib_toolkit_datasets.simulation.road import Line
from calib_toolkit_datasets.simulation.shapes import Mesh
from calib_toolkit_datasets.simulation.site import Site, turned

HIGHWAY_EDGE = 5.5
"""Half of one carriageway of a highway: two lanes and their shoulders."""
LANE_EDGE = 3.0
"""Half the width of a country lane."""


def highway(site: Site) -> None:
    """Rails, barriers, gantries and embankments with bushes."""
    rng = site.rng
    own, other = site.roads.lines[:2]
    for line, outside in ((own, -1), (other, 1)):
        facing = 0.0 if outside > 0 else np.pi
        rails = line.at(np.arange(line.s[0], line.s[-1], 4.0), outside * (HIGHWAY_EDGE + 0.6))
        site.stand([props.guard_rail()], turned(rails, facing), (4.0, 0.8), HIGHWAY_EDGE, run=True)
        median = line.at(np.arange(line.s[0], line.s[-1], 4.0), -outside * (HIGHWAY_EDGE + 0.35))
        site.stand([props.guard_rail()], turned(median, facing + np.pi), (4.0, 0.8), HIGHWAY_EDGE, run=True)
        _barriers(site, line, outside)
        posts = site.every(line, 50.0, outside * (HIGHWAY_EDGE + 1.4), 0.02)
        site.stand([props.bollard()], turned(posts, facing), (0.3, 0.3), HIGHWAY_EDGE + 0.9)
        signs = [props.sign("round"), props.sign("square"), props.board()]
        site.stand(
            signs, turned(site.every(line, 130.0, outside * 8.0), 0.0 if outside < 0 else np.pi), (0.4, 2), 6.5
        )
        plants = [props.bush(rng) for _ in range(4)]
        for left, share in ((10.0, 0.25), (13.0, 0.35), (17.0, 0.3)):
            site.stand(plants, site.every(line, 4.0, outside * left, 0.5, share), (1.2, 1.2), 9.0, stretch=0.5)
        trees = [props.tree(8.0, 2.8, rng), props.tree(11.0, 3.6, rng), props.conifer(10.0, rng)]
        site.stand(trees, site.every(line, 12.0, outside * 19.0, 0.5, 0.6), (3.0, 3.0), 15.0, stretch=0.3)
    bridge = props.gantry(HIGHWAY_EDGE + 1.0, -HIGHWAY_EDGE - 1.0)
    for line, turn in ((own, 0.0), (other, np.pi)):
        for place in turned(site.every(line, 350.0, 0.0, 0.2), turn):
            _bridge(site, bridge, place)
    _lanes(site)


def fields(site: Site) -> None:
    """A country lane with a few trees, poles and hedges, and a barn far away."""
    rng = site.rng
    lane = site.roads.lines[0]
    trees = [props.tree(h, 0.36 * h, rng) for h in (6.0, 9.0, 12.0)]
    site.stand(trees, site.scatter(45.0, 12.0, 120.0, 0.35), (3.0, 3.0), 8.0, stretch=0.3)
    site.stand([props.cable_pole()], site.every(lane, 55.0, 7.0, 0.05), (0.4, 0.4), 6.0)
    site.stand([props.bollard()], site.every(lane, 60.0, -4.2, 0.05), (0.3, 0.3), 3.9)
    site.stand([props.sign("triangle")], site.every(lane, 180.0, -4.6), (0.4, 0.4), 4.2)
    rows = [props.hedge(rng, height=1.6) for _ in range(4)]
    for start in np.arange(lane.s[0], lane.s[-1], 160.0) + rng.uniform(0, 60):
        pieces = lane.at(np.arange(start, start + 40, 2.5), rng.choice([-1, 1]) * rng.uniform(9, 30))
        site.stand(rows, pieces, (2.5, 0.8), 6.0, run=True)
    for place in site.scatter(110.0, 45.0, 110.0, 0.25):
        if site.free(place[None], (18, 10), 30.0, 5.0)[0]:
            site.put_level(barn(18, 10, 4.5, "wood", rng), place[None])
    s = np.arange(lane.s[0], lane.s[-1], 2.0)
    for left in (-LANE_EDGE + 0.25, LANE_EDGE - 0.25):
        clear = np.interp(s, lane.s, ~site.roads.joined(lane, 8.0)) > 0.99
        site.meshes.append(site.ground.stripes(lane, s[clear], np.full(int(clear.sum()), left), 2.0, 0.12))


def _barriers(site: Site, line: Line, outside: int) -> None:
    for start in np.arange(line.s[0], line.s[-1], 260.0) + site.rng.uniform(0, 120):
        pieces = line.at(np.arange(start, start + 100, 4.0), outside * (HIGHWAY_EDGE + 2.6))
        facing = 0.0 if outside > 0 else np.pi
        site.stand([props.noise_barrier()], turned(pieces, facing), (4.0, 0.8), HIGHWAY_EDGE + 2, run=True)


def _bridge(site: Site, mesh: Mesh, place: Array) -> None:
    """A gantry stands only where both its legs do."""
    aside = np.array([-np.sin(place[2]), np.cos(place[2]), 0.0]) * (HIGHWAY_EDGE + 1.0)
    if np.all(site.roads.distance((place + [[1], [-1]] * aside)[:, :2]) > HIGHWAY_EDGE + 0.5):
        site.put_level(mesh, place[None])


def _lanes(site: Site) -> None:
    for line in site.roads.lines:
        plain = ~site.roads.joined(line, 9.0)
        for left, spacing, length in ((0.0, 12.0, 4.0), (3.6, 2.0, 2.0), (-3.6, 2.0, 2.0)):
            s = np.arange(line.s[0] + 2, line.s[-1] - 2, spacing)
            s = s[np.interp(s, line.s, plain) > 0.99]
            site.meshes.append(site.ground.stripes(line, s, np.full(len(s), left), length, 0.15))
