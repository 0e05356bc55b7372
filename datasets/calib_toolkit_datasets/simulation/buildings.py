"""Buildings: walls with recessed windows and doors, roofs, arcades.

Each has its front along x at y = 0 and stands behind it, x from minus to plus half its width; z = 0 is the ground.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit_datasets.simulation.shapes import MATERIAL, Array, Mesh, box, merge, place, quads, ring, tube

FLOOR = 2.9
CELLAR = 1.5
"""Metres that walls go on below the ground, so that they stand on slopes too."""


@dataclass(frozen=True)
class Openings:
    """Rectangular holes, one in each of k cells of a wall, centred across it.

    width, sill, top: (k,) metres, sill and top above the cell's bottom; width 0 for a blank cell.
    behind: (k,) index of the material that closes it, ``recess`` metres behind the wall.
    """

    width: Array
    sill: Array
    top: Array
    behind: NDArray[np.uint8]
    recess: float = 0.2


def wall(width: float, bottom: float, rows: int, cells: Openings, height: float, material: str) -> Mesh:
    """A wall of ``rows`` rows of cells, each ``height`` high, from ``bottom`` up; cells row by row from the left."""
    columns = len(cells.width) // rows
    x = (np.tile(np.arange(columns) + 0.5, rows) / columns - 0.5) * width
    z = np.asarray(bottom + np.repeat(np.arange(rows), columns) * height, dtype=float)
    half = np.full(len(x), width / columns / 2)
    outer = _upright(x, half, z, z + height, 0.0)
    open_ = cells.width > 0
    x, z, half, edge = x[open_], z[open_], cells.width[open_] / 2, outer[open_]
    sill, top = z + cells.sill[open_], z + cells.top[open_]
    hole, deep = (_upright(x, half, sill, top, y) for y in (0.0, cells.recess))
    pane = _upright(x, half - 0.07, sill + 0.07, top - 0.07, cells.recess - 0.02)
    bar = _upright(x, 0.03 + 0 * half, sill, top, cells.recess - 0.03)[cells.behind[open_] == MATERIAL["glass"]]
    ledge = _upright(x, half + 0.08, sill - 0.07, sill, 0.0)[cells.sill[open_] > 0.3]
    proud = ledge - [0.0, 0.07, 0.0]
    return merge(
        [
            quads(np.concatenate([outer[~open_], ring(edge, hole), ring(hole, deep)]), material),
            quads(np.concatenate([ring(deep, pane), bar]), "wood"),
            quads(pane, cells.behind[open_]),
            quads(np.concatenate([proud, ring(ledge, proud)]), "concrete"),
        ]
    )


def house(width: float, depth: float, floors: int, material: str, flat: bool, rng: np.random.Generator) -> Mesh:
    """A town house: windows and a door in front, a few windows at its sides, a pitched or flat roof."""
    columns = max(2, round(width / rng.uniform(2.2, 3.0)))
    front = _windows(columns, floors, 0.95, rng)
    door = rng.integers(columns)
    front.width[door], front.sill[door], front.top[door] = rng.choice([1.05, 1.3, 2.3]), 0.0, 2.2
    front.behind[door] = MATERIAL["wood"]
    side = _windows(max(1, round(depth / 4)), floors, 0.4, rng)
    top = floors * FLOOR + 0.3
    facade = wall(width, 0.3, floors, front, FLOOR, material)
    gable = wall(depth, 0.3, floors, side, FLOOR, material)
    parts = [
        facade,
        place(gable, [width / 2, depth / 2, 0, np.pi / 2], 0),
        place(gable, [-width / 2, depth / 2, 0, -np.pi / 2], 0),
        quads([_face(width, depth, 0.3, top)], material),
        box([-width / 2 - 0.04, -0.04, -CELLAR], [width / 2 + 0.04, depth + 0.04, 0.3], "concrete"),
        _step(width, columns, int(door)),
        tube([[width / 2 - 0.15, -0.08, 0], [width / 2 - 0.15, -0.08, top]], [0.05, 0.05], "metal"),
    ]
    parts.append(_flat_roof(width, depth, top, material) if flat else _gable_roof(width, depth, top, material, rng))
    if rng.random() < 0.3 and floors > 1:
        parts.append(_balcony(width, columns, int(rng.integers(columns))))
    return merge(parts)


def arcade(width: float, floors: int, material: str, rng: np.random.Generator) -> Mesh:
    """A long building, 9 m deep, with a covered walk behind wide openings, windows above, and a flat roof."""
    depth, columns = 9.0, max(3, round(width / 3.6))
    ground = Openings(
        np.full(columns, 2.5),
        np.zeros(columns),
        np.full(columns, 3.3) + 0.2 * rng.random(),
        np.full(columns, MATERIAL["plaster"], dtype=np.uint8),
        recess=2.6,
    )
    top = 4.2 + floors * 3.6
    above = _windows(columns, floors, 0.97, rng)
    columns_out = [
        box([x - 0.25, -0.35, -CELLAR], [x + 0.25, 0.0, 3.9], material)
        for x in (np.arange(columns + 1) / columns - 0.5) * width
    ]
    inner = place(wall(width, 0.0, 1, _doors(columns, rng), 3.4, "plaster"), [0, 2.35, 0, 0], 0)
    return merge(
        [
            wall(width, 0.0, 1, ground, 4.2, material),
            wall(width, 4.2, floors, above, 3.6, material),
            box([-width / 2, -0.25, 3.9], [width / 2, 0.0, 4.25], "concrete"),
            box([-width / 2, -0.05, -CELLAR], [width / 2, 0.0, 0.05], "concrete"),
            inner,
            *columns_out,
            quads(_sides(width, depth, -CELLAR, top), material),
            _flat_roof(width, depth, top, material),
        ]
    )


def barn(width: float, depth: float, height: float, material: str, rng: np.random.Generator) -> Mesh:
    """A plain building with a pitched roof: a barn near by, any house far away."""
    gate = quads([_face(-min(3.0, width / 2), -0.04, 0, 0.7 * height)], "wood")
    shell = quads([*_sides(width, depth, -4 * CELLAR, height), _face(-width, 0.0, -4 * CELLAR, height)], material)
    return merge([shell, gate, _gable_roof(width, depth, height, material, rng)])


def block(width: float, depth: float, height: float, material: str) -> Mesh:
    """A tall block seen from far: bands of windows round a plain box."""
    bands = [
        box([-width / 2 - 0.1, -0.1, z + 1.0], [width / 2 + 0.1, depth + 0.1, z + 2.4], "glass")
        for z in np.arange(0.0, height - FLOOR, FLOOR)
    ]
    return merge([box([-width / 2, 0, -4 * CELLAR], [width / 2, depth, height], material), *bands])


def _windows(columns: int, floors: int, share: float, rng: np.random.Generator) -> Openings:
    n = columns * floors
    width = np.where(rng.random(n) < share, float(rng.choice([0.9, 1.1, 1.4])), 0.0)
    sill: Array = np.full(n, rng.uniform(0.75, 0.95))
    return Openings(width, sill, sill + rng.uniform(1.2, 1.5), np.full(n, MATERIAL["glass"], dtype=np.uint8))


def _doors(columns: int, rng: np.random.Generator) -> Openings:
    n = columns
    width = np.where(rng.random(n) < 0.6, 1.2, 0.0)
    behind = np.where(rng.random(n) < 0.5, MATERIAL["wood"], MATERIAL["glass"]).astype(np.uint8)
    return Openings(width, np.full(n, 0.1), np.full(n, 2.4), behind)


def _upright(x: Array, half: Array, low: Array, high: Array, y: float) -> Array:
    """Rectangles (k, 4, 3) in the plane of a wall, ``y`` metres behind its front."""
    corners = [(x - half, low), (x + half, low), (x + half, high), (x - half, high)]
    return np.stack([np.stack([a, np.full(len(a), y), b], axis=-1) for a, b in corners], axis=1)


def _face(width: float, y: float, low: float, high: float) -> Array:
    """One rectangle across the building, ``y`` metres behind the front. (4, 3)."""
    w = width / 2
    return np.array([[w, y, low], [-w, y, low], [-w, y, high], [w, y, high]])


def _sides(width: float, depth: float, low: float, high: float) -> Array:
    """Left, right and back. (3, 4, 3)."""
    w = width / 2
    left = [[-w, 0, low], [-w, depth, low], [-w, depth, high], [-w, 0, high]]
    right = [[w, 0, low], [w, depth, low], [w, depth, high], [w, 0, high]]
    return np.array([left, right, _face(width, depth, low, high).tolist()])


def _gable_roof(width: float, depth: float, top: float, material: str, rng: np.random.Generator) -> Mesh:
    w, rise, eave = width / 2, depth * rng.uniform(0.25, 0.5), 0.35
    slope = rise / (depth / 2)
    profile = [(-eave, top - slope * eave), (depth / 2, top + rise), (depth + eave, top - slope * eave)]
    over = [[(x, y, z + dz) for y, z in profile] for x, dz in ((-w - 0.2, 0.12), (w + 0.2, 0.12))]
    under = [[(x, y, z) for y, z in profile] for x in (-w - 0.2, w + 0.2)]
    skins = [[a[k], b[k], b[k + 1], a[k + 1]] for a, b in (over, under) for k in (0, 1)]
    edges = [[o[k], o[k + 1], u[k + 1], u[k]] for o, u in zip(over, under, strict=True) for k in (0, 1)]
    fronts = [[over[0][k], over[1][k], under[1][k], under[0][k]] for k in (0, 2)]
    gables = [[(x, 0, top), (x, depth, top), (x, depth / 2, top + rise)] * 2 for x in (-w, w)]
    x = rng.uniform(-0.35, 0.35) * width
    chimney = box([x - 0.3, depth * 0.6, top], [x + 0.3, depth * 0.6 + 0.5, top + rise + 0.7], "brick")
    sides = quads([[g[0], g[1], g[2], g[2]] for g in gables], material)
    return merge([quads([*skins, *edges, *fronts], "roof"), sides, chimney])


def _flat_roof(width: float, depth: float, top: float, material: str) -> Mesh:
    w = width / 2
    lid = quads([[[-w, 0, top], [w, 0, top], [w, depth, top], [-w, depth, top]]], "roof")
    rim = box([-w - 0.12, -0.12, top], [w + 0.12, 0.2, top + 0.5], "concrete")
    hut = box([-w * 0.4, depth * 0.4, top], [-w * 0.4 + 2.0, depth * 0.4 + 2.5, top + 1.8], material)
    return merge([lid, rim, hut])


def _step(width: float, columns: int, door: int) -> Mesh:
    x = ((door + 0.5) / columns - 0.5) * width
    return box([x - 0.9, -0.7, -CELLAR], [x + 0.9, 0.0, 0.15], "concrete")


def _balcony(width: float, columns: int, column: int) -> Mesh:
    x, z = ((column + 0.5) / columns - 0.5) * width, FLOOR + 0.4
    slab = box([x - 1.1, -1.0, z], [x + 1.1, 0.0, z + 0.15], "concrete")
    rail = [box([x - 1.1, -1.0, z + 1.0], [x + 1.1, -0.95, z + 1.06], "metal")]
    rail += [box([x + d, -1.0, z], [x + d + 0.03, -0.96, z + 1.0], "metal") for d in np.arange(-1.1, 1.1, 0.27)]
    return merge([slab, *rail])
