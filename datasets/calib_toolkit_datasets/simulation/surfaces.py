"""What a ray meets: the interface between the scene, which is cast, and the sensors, which look at it."""

from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

MATERIALS = (
    *("asphalt", "marking", "pavement", "kerb", "grass", "earth"),
    *("plaster", "brick", "concrete", "wood", "glass", "roof"),
    *("bark", "leaves", "metal", "paint", "rubber", "cloth", "sign"),
)
"""What surfaces are made of; ``Hits.material`` is an index into this."""


@dataclass(frozen=True)
class Hits:
    """The first surface along each of n rays.

    distance: (n,) metres, inf where there is only sky (the other fields are then meaningless).
    position, normal: (n, 3) in the axes in which the surface's texture is fixed: the world, or a moving object's own.
    normal_world: (n, 3) unit, towards the side that the ray came from.
    material: (n,) uint8, an index of ``MATERIALS``. tone: (n,) from 0 to 1, drawn once for each object.
    """

    distance: Floats
    position: Floats
    normal: Floats
    normal_world: Floats
    material: NDArray[np.uint8]
    tone: Floats

    def __getitem__(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> "Hits":
        return Hits(*(getattr(self, f.name)[chosen] for f in fields(self)))


class Scene(Protocol):
    """Anything that rays can be cast into."""

    def cast(self, origins: Array, directions: Array, stamps: Array) -> Hits:
        """What each ray meets at its own instant. (n, 3) world metres, (n, 3) unit, (n,) seconds -> n hits."""
        ...
