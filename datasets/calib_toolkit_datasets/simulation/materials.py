"""What surfaces look like: to a camera, and to a lidar at 905 nm.

The numbers are typical of diffuse reflectances in the field's spectral libraries (ASTER, ECOSTRESS), rounded.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit_datasets.simulation.surfaces import MATERIALS

Floats = NDArray[np.float32]
Colour = tuple[float, float, float, float]
SHADES = 16


@dataclass(frozen=True)
class Layer:
    """One pattern laid over a surface. pattern: a name of ``texture.PATTERNS``; tile: metres that it spans.

    contrast: of the albedo where the pattern is at its extremes; infrared: the same of the lidar's reflectance.
    """

    pattern: str
    tile: float
    contrast: float
    infrared: float


@dataclass(frozen=True)
class Material:
    """One entry of ``MATERIALS``.

    colours: diffuse reflectance in blue, green, red and at 905 nm; each object has one of them, chosen by its tone.
    A reflectance above one belongs to a retroreflector. detail: bricks, leaves; coarse: stains, patches.
    mirror: share of the light that is reflected as by a mirror when looked at head on.
    """

    colours: tuple[Colour, ...]
    detail: Layer
    coarse: Layer
    mirror: float = 0.0


def palette() -> Floats:
    """Blue, green, red and infrared reflectance by material and shade, (materials, ``SHADES``, 4)."""
    rows = [_OF[name].colours for name in MATERIALS]
    return np.array([[colours[k * len(colours) // SHADES] for k in range(SHADES)] for colours in rows], np.float32)


def mirrors() -> Floats:
    """Share of light mirrored head on, by material, (materials,)."""
    return np.array([_OF[name].mirror for name in MATERIALS], np.float32)


def layers() -> tuple[list[Layer], list[Layer]]:
    """Detail and coarse layer of every material, in the order of ``MATERIALS``."""
    return [_OF[name].detail for name in MATERIALS], [_OF[name].coarse for name in MATERIALS]


_WALLS: tuple[Colour, ...] = (
    *((0.62, 0.68, 0.70, 0.66), (0.38, 0.52, 0.60, 0.58), (0.28, 0.45, 0.58, 0.60), (0.50, 0.50, 0.48, 0.42)),
    *((0.30, 0.34, 0.48, 0.52), (0.70, 0.72, 0.72, 0.62), (0.24, 0.28, 0.30, 0.40), (0.42, 0.46, 0.40, 0.50)),
)
_PAINTS: tuple[Colour, ...] = (
    *((0.02, 0.02, 0.02, 0.06), (0.65, 0.66, 0.66, 0.70), (0.40, 0.40, 0.40, 0.45), (0.03, 0.04, 0.35, 0.45)),
    *((0.28, 0.12, 0.04, 0.20), (0.12, 0.12, 0.12, 0.15), (0.07, 0.14, 0.06, 0.25), (0.30, 0.36, 0.40, 0.55)),
)
_STAINS = Layer("blotches", 9.0, 0.18, 0.15)
_OF = {
    "asphalt": Material(
        ((0.11, 0.11, 0.11, 0.13), (0.09, 0.09, 0.09, 0.15)),
        Layer("grain", 2.3, 0.5, 0.15),
        Layer("repairs", 13.0, 0.65, 0.35),
    ),
    "marking": Material(((0.55, 0.58, 0.58, 0.8),), Layer("grain", 1.3, 0.3, 0.1), Layer("blotches", 3.0, 0.35, 0.2)),
    "pavement": Material(
        ((0.24, 0.26, 0.27, 0.30), (0.17, 0.20, 0.24, 0.34), (0.28, 0.29, 0.29, 0.28)),
        Layer("slabs", 3.2, 0.5, 0.2),
        _STAINS,
    ),
    "kerb": Material(((0.32, 0.33, 0.34, 0.36),), Layer("slabs", 4.0, 0.4, 0.15), _STAINS),
    "grass": Material(
        ((0.035, 0.13, 0.075, 0.48), (0.04, 0.11, 0.09, 0.42)),
        Layer("clumps", 2.7, 0.8, 0.25),
        Layer("blotches", 14.0, 0.3, 0.1),
    ),
    "earth": Material(
        ((0.12, 0.17, 0.22, 0.30), (0.16, 0.20, 0.24, 0.34)),
        Layer("clumps", 2.1, 0.7, 0.15),
        Layer("blotches", 8.0, 0.35, 0.2),
    ),
    "plaster": Material(_WALLS, Layer("plaster", 5.0, 0.25, 0.1), _STAINS),
    "brick": Material(
        ((0.08, 0.11, 0.26, 0.38), (0.11, 0.14, 0.20, 0.30), (0.20, 0.30, 0.38, 0.46)),
        Layer("bricks", 2.0, 0.6, 0.25),
        _STAINS,
    ),
    "concrete": Material(
        ((0.30, 0.32, 0.32, 0.36), (0.22, 0.23, 0.23, 0.30)),
        Layer("plaster", 3.0, 0.35, 0.15),
        Layer("slabs", 11.0, 0.2, 0.05),
    ),
    "wood": Material(
        ((0.06, 0.11, 0.18, 0.45), (0.10, 0.16, 0.24, 0.52), (0.05, 0.08, 0.05, 0.30), (0.45, 0.48, 0.48, 0.55)),
        Layer("planks", 2.0, 0.5, 0.15),
        _STAINS,
    ),
    "glass": Material(
        ((0.025, 0.025, 0.025, 0.03), (0.10, 0.11, 0.11, 0.06), (0.04, 0.05, 0.05, 0.03)),
        Layer("blotches", 2.6, 0.4, 0.1),
        Layer("blotches", 1.7, 0.3, 0.1),
        mirror=0.15,
    ),
    "roof": Material(
        ((0.06, 0.09, 0.22, 0.30), (0.09, 0.09, 0.10, 0.16), (0.07, 0.10, 0.16, 0.26)),
        Layer("tiles", 2.4, 0.6, 0.2),
        _STAINS,
    ),
    "bark": Material(
        ((0.06, 0.08, 0.10, 0.32), (0.10, 0.12, 0.13, 0.36)),
        Layer("bark", 1.0, 0.7, 0.2),
        Layer("blotches", 1.5, 0.3, 0.1),
    ),
    "leaves": Material(
        ((0.025, 0.11, 0.06, 0.50), (0.03, 0.08, 0.035, 0.44), (0.03, 0.13, 0.10, 0.52), (0.03, 0.04, 0.07, 0.46)),
        Layer("leaves", 2.2, 0.95, 0.3),
        Layer("blotches", 3.1, 0.5, 0.15),
    ),
    "metal": Material(
        ((0.32, 0.33, 0.33, 0.40), (0.10, 0.11, 0.11, 0.25)),
        Layer("plaster", 2.0, 0.2, 0.1),
        Layer("blotches", 1.3, 0.2, 0.1),
        mirror=0.1,
    ),
    "paint": Material(_PAINTS, Layer("blotches", 2.6, 0.12, 0.05), Layer("plaster", 1.5, 0.1, 0.05), mirror=0.05),
    "rubber": Material(((0.02, 0.02, 0.02, 0.04),), Layer("grain", 0.8, 0.4, 0.1), Layer("blotches", 0.6, 0.3, 0.1)),
    "cloth": Material(_PAINTS + _WALLS, Layer("plaster", 1.1, 0.25, 0.15), Layer("blotches", 0.9, 0.35, 0.2)),
    "sign": Material(
        ((0.60, 0.62, 0.62, 2.5), (0.45, 0.12, 0.03, 1.6), (0.04, 0.55, 0.65, 2.2), (0.04, 0.05, 0.45, 1.5)),
        Layer("glyphs", 0.9, 0.8, 0.4),
        Layer("blotches", 1.7, 0.1, 0.1),
    ),
}
