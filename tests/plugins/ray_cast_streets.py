"""Sweeps of a moving scanner on ray-cast streets, the motion being known."""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Scan, Stream, se3

Array = NDArray[np.float64]
PERIOD = 0.1
FORWARD = np.array([1.2, 0.01, 0.005, 0.002, -0.003, 0.02])
GROUND = -1.8
BEAMS, COLUMNS = 40, 720


def street(seed: int) -> Array:
    """(n, 7) boxes: centre, half sizes, yaw. Houses on both sides, cars, poles."""
    rng = np.random.default_rng(seed)
    boxes = []
    for side in (-1, 1):
        x = -60.0
        while x < 60.0:
            length, depth, height = rng.uniform([6, 4, 4], [18, 6, 9])
            y = side * (rng.uniform(8, 13) + depth / 2)
            boxes.append(
                [x + length / 2, y, height / 2 + GROUND, length / 2, depth / 2, height / 2, rng.normal(0, 0.06)]
            )
            x += length + rng.uniform(0.5, 6)
    for half, number, near, far in (([2.1, 0.9, 0.75], 14, 4.0, 6.0), ([0.15, 0.15, 2.8], 16, 5.5, 7.5)):
        x, y = rng.uniform(-50, 50, number), rng.choice([-1, 1], number) * rng.uniform(near, far, number)
        boxes += [[x[i], y[i], GROUND + half[2], *half, rng.normal(0, 0.3)] for i in range(number)]
    return np.array(boxes)


def sweep(
    boxes: Array,
    T_world_mid: Array,
    step: Array,
    rng: np.random.Generator,
    sigma: float,
    rings: int = BEAMS,
    more: float | Array = 0.0,
) -> Scan:
    """One clockwise sweep of a scanner that moves by ``step`` a period, and by ``more`` of it each period; its stamp
    is the middle."""
    return swept(
        boxes,
        lambda part: T_world_mid @ se3.matrix(part[:, None] * step + part[:, None] ** 2 / 2 * more),
        rng,
        sigma,
        rings,
    )


def swept(
    boxes: Array, path: Callable[[Array], Array], rng: np.random.Generator, sigma: float, rings: int = BEAMS
) -> Scan:
    """One clockwise sweep from where path, of periods since the middle of it, (n,) to (n, 4, 4), says."""
    azimuth = -np.pi + (np.arange(COLUMNS) + 0.5) * 2 * np.pi / COLUMNS
    azimuth, elevation = (m.ravel() for m in np.meshgrid(azimuth, np.radians(np.linspace(-24.8, 2, rings))))
    part = -azimuth / (2 * np.pi)
    beams = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    T = path(part)
    ranges = first_hit(boxes, T[:, :3, 3], np.einsum("nij,nj->ni", T[:, :3, :3], beams))
    hit = ranges < 80.0
    ranges = ranges + sigma * rng.standard_normal(len(ranges))
    points = (beams * ranges[:, None])[hit]
    return Scan(points.astype(np.float32), (part[hit] * PERIOD).astype(np.float32))


def drive(boxes: Array, step: Array, number: int, seed: int = 0, sigma: float = 0.02) -> Stream:
    """Equal steps from the origin."""
    rng = np.random.default_rng(seed)
    poses = [np.linalg.matrix_power(se3.matrix(step), k) for k in range(number)]
    return Stream("velo", "velodyne", PERIOD * np.arange(number), [sweep(boxes, T, step, rng, sigma) for T in poses])


def first_hit(boxes: Array, origin: Array, beam: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        down = (GROUND - origin[:, 2]) / beam[:, 2]
        nearest = np.where(down > 0, down, np.inf)
        level = np.linalg.norm(beam[:, :2], axis=1)
        for box in boxes:
            x, y = (box[:2] - origin[:, :2]).T
            near = np.abs(beam[:, 0] * y - beam[:, 1] * x) <= np.hypot(box[3], box[4]) * level  # others pass it by
            R_box_world = se3.exp_so3([0.0, 0.0, -box[6]])
            start, along = (origin[near] - box[:3]) @ R_box_world.T, beam[near] @ R_box_world.T
            one, other = (-box[3:6] - start) / along, (box[3:6] - start) / along
            enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
            hit = (enter < leave) & (enter > 0.5) & (enter < nearest[near])
            nearest[near] = np.where(hit, enter, nearest[near])
    return nearest


@cache
def forward() -> Stream:
    """Four sweeps of a drive along a street."""
    return drive(street(1), FORWARD, 4)
