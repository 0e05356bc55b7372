"""A residential street: rows of houses behind pavements and front gardens, parked cars, lamps, signs and trees."""

import numpy as np

from calib_toolkit_datasets.simulation import props
from calib_toolkit_datasets.simulation.buildings import house
from calib_toolkit_datasets.simulation.road import Line
from calib_toolkit_datasets.simulation.site import Site, turned

EDGE = 5.7
"""Half the carriageway: a lane and a row of parked cars."""
WALK = 8.0
"""The far edge of the pavement, from the middle of the road."""


def furnish(site: Site) -> None:
    """Fills both sides of every road."""
    rng = site.rng
    trees = [props.tree(h, 0.33 * h, rng) for h in (6.0, 7.5, 9.0)]
    bushes = [props.bush(rng) for _ in range(3)]
    for line in site.roads.lines:
        for side in (1, -1):
            _houses(site, line, side)
    for line in site.roads.lines:
        for side in (1, -1):
            _kerbside(site, line, side)
            site.stand(trees, site.every(line, 14.0, side * 7.0, share=0.35), (0.9, 0.9), 6.2, stretch=0.15)
            site.stand(trees, site.every(line, 11.0, side * 11.0, share=0.4), (2.5, 2.5), 9.5, stretch=0.25)
            site.stand(bushes, site.every(line, 3.0, side * 9.6, share=0.4), (1.2, 1.2), 8.9, stretch=0.4)
    _marks(site)


def _houses(site: Site, line: Line, side: int) -> None:
    """Rows of two to five houses with one front line and one boundary, and gaps between the rows."""
    rng, s = site.rng, line.s[0]
    bounds = [[props.garden_wall()], [props.fence()], [props.hedge(rng) for _ in range(4)]]
    while s < line.s[-1]:
        setback = rng.choice([0.3, 2.2, 3.5, 5.0])
        flat, floors = rng.random() < 0.2, rng.integers(2, 5 if setback < 1 else 4)
        first = s
        for _ in range(rng.integers(1, 5)):
            width, depth = rng.uniform(7.0, 13.0), rng.uniform(8.0, 10.5)
            material = str(rng.choice(["plaster", "plaster", "brick", "concrete"]))
            front = line.at([s + width / 2], side * (WALK + 0.25 + setback))
            tall = int(np.clip(floors + rng.integers(-1, 2), 1, 4))
            place = turned(front, 0.0 if side > 0 else np.pi)
            if site.free(place, (width, depth), WALK + 0.2, depth / 2)[0]:
                site.put_level(house(width, depth, tall, material, bool(flat), rng), place)
            s += width + rng.choice([0.02, 0.02, 3.0])
        gap = rng.uniform(1.5, 7.0)
        if setback > 2:
            pieces = line.at(np.arange(first, s + gap, 2.5), side * (WALK + 0.4))
            # a gate is left out here and there
            pieces = pieces[rng.random(len(pieces)) < 0.85]
            site.stand(
                bounds[rng.integers(3)], turned(pieces, 0.0 if side > 0 else np.pi), (2.5, 0.8), WALK, run=True
            )
        s += gap


def _kerbside(site: Site, line: Line, side: int) -> None:
    rng = site.rng
    facing = 0.0 if side < 0 else np.pi
    s = np.arange(line.s[0] + rng.uniform(0, 5), line.s[-1], 6.0)
    # cars stand in groups: the share of taken places comes and goes along the street
    full = rng.random(len(s)) < 0.55 + 0.4 * np.sin(s / 17.0 + rng.uniform(0, 6))
    cars = [props.car(k) for k in ("hatchback", "saloon", "hatchback", "van")]
    spots = line.at(s[full] + rng.uniform(-0.3, 0.3, int(full.sum())), side * (EDGE - 1.1 + rng.normal(0, 0.05)))
    site.stand(cars, turned(spots, facing), (4.9, 1.9), 3.6, stretch=0.05)
    signs = [props.sign(shape) for shape in ("round", "square", "triangle")]
    site.stand([props.lamp()], turned(site.every(line, 28.0, side * 6.25, 0.1), facing), (0.3, 0.3), EDGE + 0.3)
    site.stand(signs, turned(site.every(line, 24.0, side * 6.2, share=0.8), facing), (0.3, 0.3), EDGE + 0.3)
    site.stand([props.bin_()], turned(site.every(line, 13.0, side * 7.55, share=0.4), facing), (0.7, 0.7), 7.0)
    if side < 0:
        site.stand([props.cable_pole()], site.every(line, 36.0, side * 7.7, 0.1), (0.4, 0.4), 7.2)


def _marks(site: Site) -> None:
    for line in site.roads.lines:
        plain = ~site.roads.joined(line, 9.0)
        s = np.arange(line.s[0] + 3, line.s[-1] - 3, 6.0)
        s = s[np.interp(s, line.s, plain) > 0.99]
        site.meshes.append(site.ground.stripes(line, s, 0 * s, 3.0, 0.12))
        for crossing in np.arange(line.s[0] + 40, line.s[-1] - 10, 90.0) + site.rng.uniform(-20, 20):
            if np.all(np.interp(crossing + np.array([-3.0, 3.0]), line.s, plain) > 0.99):
                left = np.arange(-EDGE + 0.6, EDGE - 0.3, 1.0)
                site.meshes.append(site.ground.stripes(line, np.full(len(left), crossing), left, 3.0, 0.5))
