"""A courtyard on unpaved ground: a quadrangle of buildings with arcades, a few trees, benches and lamps."""

import numpy as np

from calib_toolkit_datasets.simulation import props
from calib_toolkit_datasets.simulation.buildings import arcade, house
from calib_toolkit_datasets.simulation.ground import Array
from calib_toolkit_datasets.simulation.shapes import Mesh
from calib_toolkit_datasets.simulation.site import Site

SIZE = np.array([60.0, 45.0])
MARGIN = 12.0
"""Metres between the vehicle's path and the buildings, at least."""


def extent(driven: Array) -> Array:
    """Two opposite corners of the court round a path (n, 2): (2, 2) metres."""
    low, high = driven.min(axis=0), driven.max(axis=0)
    half = np.maximum(SIZE / 2, (high - low) / 2 + MARGIN)
    return (low + high) / 2 + np.array([-half, half])


def furnish(site: Site) -> None:
    """Builds the quadrangle, and what stands inside it where the vehicle does not go."""
    rng = site.rng
    low, high = extent(site.main.xy)
    _quadrangle(site, low, high)
    inside = site.scatter(9.0, 3.0, float(np.max(high - low)))
    inside = inside[np.all((inside[:, :2] > low + 3) & (inside[:, :2] < high - 3), axis=1)]
    # a court larger than usual has more buildings inside, so that there is always something near
    wide = float(np.min(high - low)) > 80.0
    for place in inside[:: max(1, len(inside) // 40)] if wide else inside[:0]:
        width, depth = rng.uniform(8, 14), rng.uniform(7, 10)
        if site.free(place[None], (width, depth), 9.0, depth / 2)[0]:
            tall, flat = int(rng.integers(1, 4)), bool(rng.random() < 0.5)
            site.put_level(house(width, depth, tall, "brick", flat, rng), place[None])
    trees = [props.tree(h, 0.34 * h, rng) for h in (5.0, 7.0, 10.0)]
    few = inside[rng.random(len(inside)) < 0.45]
    kinds = np.array_split(rng.permutation(few), 5)
    site.stand(trees, np.concatenate(kinds[:2]), (1.5, 1.5), 3.4, stretch=0.2)
    site.stand([props.bench()], kinds[2], (1.9, 0.8), 2.6)
    site.stand([props.lamp(), props.sign("square")], kinds[3], (0.4, 0.4), 2.4)
    site.stand([props.bush(rng), props.bush(rng)], kinds[4], (1.4, 1.4), 2.8, stretch=0.3)
    site.stand([props.bin_()], kinds[2] + [2.0, 0.5, 0.0], (0.7, 0.7), 2.5)


def _quadrangle(site: Site, low: Array, high: Array) -> None:
    rng = site.rng
    middle = (low + high) / 2
    for yaw in np.arange(4) * np.pi / 2:
        cos, sin = round(np.cos(yaw)), round(np.sin(yaw))
        half = (high - low) / 2
        length, away = (half[0], half[1]) if sin == 0 else (half[1], half[0])
        x = -length - 9.0
        while x < length:
            width = min(rng.uniform(14.0, 24.0), length + 9.0 - x)
            if width > 6:
                # each stands a little before or behind its neighbour
                at, out = x + width / 2, away + rng.uniform(0.0, 1.5)
                xy = middle + np.array([cos * at - sin * out, sin * at + cos * out])
                place = np.array([[*xy, yaw]])
                if site.free(place, (width, 9.0), MARGIN - 4, 4.5)[0]:
                    site.put_level(_building(width, rng), place)
            x += width + (3.5 if rng.random() < 0.25 else 0.02)


def _building(width: float, rng: np.random.Generator) -> Mesh:
    material, floors = str(rng.choice(["brick", "concrete", "plaster"])), int(rng.integers(1, 4))
    if rng.random() < 0.6:
        return arcade(width, floors, material, rng)
    return house(width, 9.0, floors, material, True, rng)
