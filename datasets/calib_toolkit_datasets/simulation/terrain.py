"""The ground: long gentle slopes, the same for the vehicle that drives on it and for the scene that shows it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FLAT = ("planar", "straight", "turn", "static")


@dataclass(frozen=True)
class Terrain:
    """A sum of waves. amplitude: (k,) metres; wave: (k, 2) radians per metre; phase: (k,)."""

    amplitude: Array
    wave: Array
    phase: Array

    def height(self, xy: Array) -> Array:
        """Metres above the origin, (..., 2) -> (...)."""
        return np.sin(xy @ self.wave.T + self.phase) @ self.amplitude

    def gradient(self, xy: Array) -> Array:
        """Slope along x and y, (..., 2) -> (..., 2)."""
        return (np.cos(xy @ self.wave.T + self.phase) * self.amplitude) @ self.wave


def terrain(seed: int, drive: str) -> Terrain:
    """Slopes of a few per cent over hundreds of metres; none for the drives that must stay level."""
    rng = np.random.default_rng([seed, 1])
    length = rng.uniform(120.0, 500.0, 6)
    heading = rng.uniform(0.0, 2 * np.pi, 6)
    wave = (2 * np.pi / length)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    steepness = 0.0 if drive in FLAT else 0.022
    return Terrain(steepness / np.linalg.norm(wave, axis=1), wave, rng.uniform(0.0, 2 * np.pi, 6))
