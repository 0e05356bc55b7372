"""Texture of surfaces, fixed to them in metres: looked up in an atlas of patterns, blurred to the pixel's size."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from calib_toolkit_datasets.simulation import materials
from calib_toolkit_datasets.simulation.surfaces import MATERIALS, Hits

Floats = NDArray[np.float32]
SIZE = 512
LEVELS = 9
BEAM = 0.003
"""Radians that a lidar's beam spreads."""
PATTERNS = (
    *("blotches", "grain", "repairs", "slabs", "clumps", "plaster"),
    *("bricks", "planks", "tiles", "bark", "leaves", "glyphs"),
)
"""Names of the patterns in the atlas; each tiles without a seam."""
GREY = np.array([0.114, 0.587, 0.299], np.float32)
"""Weights of blue, green and red in a grey image (ITU-R BT.601)."""


def albedo(hits: Hits, footprint: Floats, colour: bool = True) -> Floats:
    """Diffuse reflectance of what was hit, (n, 3) in blue, green, red, or (n,) grey.

    footprint: (n,) metres that one pixel spans on the surface; finer texture fades out. All hits must be surfaces.
    """
    detail, coarse = _tables()
    u, v = _coordinates(hits)
    factor = 1 + _pattern(detail, detail.contrast, hits.material, u, v, footprint)
    factor += _pattern(coarse, coarse.contrast, hits.material, u, v, footprint)
    np.maximum(factor, 0.05, out=factor)
    shades = _palette()[..., :3] if colour else _palette()[..., :3] @ GREY
    base = np.take(shades.reshape(-1, 3) if colour else shades.ravel(), _shade(hits), axis=0)
    return base * (factor[:, None] if colour else factor)


def reflectance(hits: Hits) -> Floats:
    """Diffuse reflectance at a lidar's 905 nm, (n,); above one for retroreflective signs.

    Shares the albedo's detail in part, and has stains of its own. All hits must be surfaces.
    """
    detail, coarse = _tables()
    u, v = _coordinates(hits)
    footprint = hits.distance * np.float32(BEAM)
    factor = 1 + _pattern(detail, detail.infrared, hits.material, u, v, footprint)
    factor += _pattern(coarse, coarse.infrared, hits.material, v, u + 5, footprint)
    return np.take(_palette()[..., 3].ravel(), _shade(hits)) * np.maximum(factor, 0.05)


def clouds(at: Floats) -> Floats:
    """How much of the sky is cloud, 0 to 1, (n,), at (n, 2) of a plane in tiles."""
    u, v = (at - np.floor(at)).T
    row = np.full(len(u), PATTERNS.index("blotches") * (SIZE + 2) + 1, np.float32)
    return np.clip(_sample(u, v, row, np.ones(len(u), np.int32)) / 90, 0, 1)


class _Layers:
    """One layer of every material as arrays that are indexed by material."""

    def __init__(self, of: list[materials.Layer]) -> None:
        self.row = np.array([PATTERNS.index(layer.pattern) * (SIZE + 2) + 1 for layer in of], np.float32)
        self.per_metre = np.array([1 / layer.tile for layer in of], np.float32)
        self.contrast = np.array([layer.contrast for layer in of], np.float32)
        self.infrared = np.array([layer.infrared for layer in of], np.float32)


@cache
def _tables() -> tuple[_Layers, _Layers]:
    detail, coarse = materials.layers()
    return _Layers(detail), _Layers(coarse)


@cache
def _palette() -> Floats:
    return materials.palette()


def _shade(hits: Hits) -> NDArray[np.int32]:
    """Index into the palette's rows, (n,)."""
    shade = np.minimum(hits.tone * materials.SHADES, materials.SHADES - 1).astype(np.int32)
    return hits.material * np.int32(materials.SHADES) + shade


def _coordinates(hits: Hits) -> tuple[Floats, Floats]:
    """Metres along the surface: east and north on level ground, along and up a wall or a roof."""
    x, y, z = hits.position.T
    nx, ny, nz = hits.normal.T
    steep = np.hypot(nx, ny)
    level = (np.abs(nz) > 0.8) & (hits.material != MATERIALS.index("roof")) | (steep < 1e-3)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.where(level, x, (y * nx - x * ny) / steep)
        v = np.where(level, y, z / steep)
    # two houses of one material differ
    return u + 37.7 * hits.tone, v + 91.3 * hits.tone


def _pattern(
    layer: _Layers, weight: Floats, material: NDArray[np.uint8], u: Floats, v: Floats, pixel: Floats
) -> Floats:
    """A layer's pattern times its weight, (n,): between two levels of the atlas, as fine as the pixel shows."""
    per_metre = layer.per_metre[material]
    level = np.log2(np.maximum(pixel * per_metre * np.float32(SIZE), 1.0))
    np.minimum(level, LEVELS - 1.001, out=level)
    lower = level.astype(np.int32)
    blend = level - lower
    u, v = u * per_metre, v * per_metre
    u, v = u - np.floor(u), v - np.floor(v)
    row = layer.row[material]
    fine = _sample(u, v, row, lower)
    fine += blend * (_sample(u, v, row, lower + 1) - fine)
    return fine * (weight * np.float32(1 / 127))[material]


_WIDTH = (SIZE >> np.arange(LEVELS)).astype(np.float32)
_LEFT = np.cumsum(np.concatenate([[1], _WIDTH[:-1] + 2])).astype(np.float32)


def _sample(u: Floats, v: Floats, row: Floats, level: NDArray[np.int32]) -> Floats:
    """The atlas at (u, v) of 0 to 1 inside the tile that starts at a row, (n,) from -127 to 127."""
    import cv2

    width = _WIDTH[level]
    shape = (len(u) // 1024 + 1, 1024)  # remap takes no image of more than 32767 columns
    at = np.empty((2, shape[0] * shape[1]), np.float32)
    at[:, len(u) :] = 0
    at[0, : len(u)] = u * width + (_LEFT[level] - np.float32(0.5))
    at[1, : len(u)] = v * width + (row - np.float32(0.5))
    found = cv2.remap(_atlas(), at[0].reshape(shape), at[1].reshape(shape), cv2.INTER_LINEAR)
    return found.reshape(-1)[: len(u)].astype(np.float32) - 128


@cache
def _atlas() -> NDArray[np.uint8]:
    """Every pattern in its own row, at full size and halved again and again to its right, with a wrapped margin."""
    import cv2

    rows = []
    for k, name in enumerate(PATTERNS):
        rng = np.random.default_rng([905, k])
        image = _MAKERS[name](rng)
        image = np.clip(image - image.mean(), -1, 1).astype(np.float32)
        row = np.zeros((SIZE + 2, int(_LEFT[-1] + _WIDTH[-1]) + 1), np.float32)
        for left, width in zip(_LEFT.astype(int), _WIDTH.astype(int), strict=True):
            level = cv2.resize(image, (width, width), interpolation=cv2.INTER_AREA)
            row[: width + 2, left - 1 : left + width + 1] = np.pad(level, 1, mode="wrap")
        rows.append(row)
    return np.rint(np.vstack(rows) * 127 + 128).astype(np.uint8)


def _noise(
    rng: np.random.Generator, finest: float, coarsest: float, slope: float = 1.0, stretch: float = 1.0
) -> Floats:
    """Seamless noise of unit deviation with waves from ``finest`` to ``coarsest`` pixels, stretched along v."""
    f = np.fft.fftfreq(SIZE)
    radius = np.hypot(f[None, :], f[:, None] * stretch)
    band = (radius >= 1 / coarsest) & (radius <= 1 / finest)
    gain = np.where(band, np.maximum(radius, 1e-6) ** -slope, 0.0)
    image = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIZE, SIZE))) * gain).real
    return np.asarray(image / image.std(), np.float32)


def _courses(rng: np.random.Generator, columns: int, rows: int, joint: float, shift: float, spread: float) -> Floats:
    """Rectangles in courses, each of its own shade, dark joints. joint: pixels; shift: of odd courses, columns."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    row = np.floor(y * rows).astype(int)
    along = (x * columns + shift * (row % 2)) % columns
    shade = rng.normal(0, spread, (rows, columns))[row, along.astype(int)]
    gap = np.minimum((along % 1) * SIZE / columns, (y * rows % 1) * SIZE / rows)
    return np.where(gap < joint, -0.9, shade + 0.1).astype(np.float32)


def _scatter(rng: np.random.Generator, count: int, length: tuple[float, float], slim: float) -> Floats:
    """Overlapping ellipses of random shade over a dark ground, wrapped at the edges."""
    import cv2

    image = np.full((SIZE, SIZE), -0.9, np.float32)
    for k in range(count):
        x, y = rng.uniform(0, SIZE, 2)
        a, turn = rng.uniform(*length), rng.uniform(0, 180)
        shade = rng.uniform(-0.9, 1.0) * (0.3 + 0.7 * k / count)
        for dx in (-SIZE, 0, SIZE):
            for dy in (-SIZE, 0, SIZE):
                if -a < x + dx < SIZE + a and -a < y + dy < SIZE + a:
                    centre = (round(x + dx), round(y + dy))
                    cv2.ellipse(image, centre, (round(a), round(a * slim)), turn, 0, 360, shade, -1)
    return image


def _repairs(rng: np.random.Generator) -> Floats:
    """A road's patches, cracks, drips and covers."""
    import cv2

    image = np.zeros((SIZE, SIZE), np.float32)
    for _ in range(9):
        (x, y), (w, h) = rng.integers(10, SIZE - 130, 2), rng.integers(15, 120, 2)
        shade = rng.uniform(-0.6, 0.5)
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), shade, -1)
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), -0.8, 1)
    for _ in range(14):
        walk = rng.uniform(60, SIZE - 60, 2) + np.cumsum(rng.normal(0, 4, (45, 2)) + rng.normal(0, 2.5, 2), axis=0)
        cv2.polylines(image, [walk.astype(np.int32).reshape(-1, 1, 2)], False, float(rng.uniform(-1, -0.6)), 1)
    for _ in range(40):
        centre = (int(rng.integers(10, SIZE - 10)), int(rng.integers(10, SIZE - 10)))
        cv2.circle(image, centre, int(rng.integers(1, 7)), float(rng.uniform(-0.9, 0.9)), -1)
    return np.asarray(image + 0.15 * _noise(rng, 4, 512), np.float32)


def _glyphs(rng: np.random.Generator) -> Floats:
    """Letters and bars of a sign."""
    cells = np.where(rng.random((16, 16)) < 0.4, -1.0, 0.5)
    cells[[0, 5, 10, 15]] = 0.5
    return np.kron(cells, np.ones((SIZE // 16, SIZE // 16))).astype(np.float32)


def _tiles(rng: np.random.Generator) -> Floats:
    shade = np.tile(np.linspace(0.4, -0.5, SIZE // 8), 8)[:, None]
    return np.asarray(_courses(rng, 12, 8, 2, 0.5, 0.2) + shade + 0.1 * _noise(rng, 3, 40), np.float32)


def _planks(rng: np.random.Generator) -> Floats:
    return np.asarray(_courses(rng, 16, 1, 3, 0.0, 0.25) + 0.2 * _noise(rng, 2, 60, 1.0, 12.0), np.float32)


_MAKERS = {
    "blotches": lambda rng: 0.4 * _noise(rng, 4, 512, 1.6),
    "grain": lambda rng: 0.4 * _noise(rng, 2, 200, 1.0),
    "repairs": _repairs,
    "slabs": lambda rng: _courses(rng, 8, 8, 3, 0.5, 0.3) + 0.15 * _noise(rng, 3, 80),
    "clumps": lambda rng: 0.4 * _noise(rng, 3, 100, 0.9),
    "plaster": lambda rng: 0.25 * _noise(rng, 2, 40, 0.5) + 0.3 * _noise(rng, 40, 512, 1.5, 2.0),
    "bricks": lambda rng: _courses(rng, 8, 32, 2.5, 0.5, 0.3) + 0.1 * _noise(rng, 2, 20),
    "planks": _planks,
    "tiles": _tiles,
    "bark": lambda rng: 0.45 * _noise(rng, 3, 80, 1.0, 6.0),
    "leaves": lambda rng: _scatter(rng, 2600, (6.0, 14.0), 0.5),
    "glyphs": _glyphs,
}
