"""How a scanner moved within a sweep: foreseen from steps, and found in the sweep."""

import numpy as np
import pytest
from ray_cast_streets import Array, street, swept

from calib_toolkit import se3
from calib_toolkit_plugins import registration
from calib_toolkit_plugins.deskewing import derivatives, deskew, settled


def test_points_are_moved_to_where_they_were_at_the_stamp() -> None:
    rng = np.random.default_rng(0)
    still, times = rng.uniform(-50, 50, (100, 3)), rng.uniform(-0.05, 0.05, 100)
    velocity, change = np.array([15.0, 0.3, -0.2, 0.02, -0.03, 0.35]), np.array([3.0, 1.0, 0.5, 0.3, 0.4, 0.2])

    def at(t: Array) -> Array:
        """In many small motions, each in the axes of the one before."""
        T = np.broadcast_to(np.eye(4), (len(t), 4, 4))
        for k in range(200):
            T = T @ se3.matrix(t[:, None] / 200 * (velocity + change * (k + 0.5) / 200 * t[:, None]))
        return T

    seen = np.einsum("nij,nj->ni", se3.invert(at(times))[:, :3, :3], still) + se3.invert(at(times))[:, :3, 3]
    assert np.abs(deskew(seen, times, velocity, change) - still).max() < 1e-3
    stamps = 0.1 * np.arange(9)
    poses = at(stamps - 0.4)
    found = derivatives(stamps, [*se3.relative(poses[:-1], poses[1:])])
    assert np.allclose(found[0][4], velocity, atol=6e-3)
    assert np.allclose(found[1][4, 3:], change[3:], atol=1e-3)


def test_derivatives_where_steps_are_missing_or_long() -> None:
    step = np.array([1.0, 0, 0, 0, 0, 0.1])
    stamps = 0.1 * np.arange(16) + 0.1 * (np.arange(16) > 12)  # one twice as long
    T = se3.matrix(step)
    steps = [None if k in (6, 7) else T @ T if k == 12 else T for k in range(15)]
    velocity, change = derivatives(stamps, steps)
    assert [*np.flatnonzero(np.isnan(velocity[:, 0]))] == [7]
    told = np.delete(np.arange(16), 7)
    even = [*np.linalg.solve(se3.left_jacobian(step[3:]), step[:3]) * 10, 0.0, 0.0, 1.0]
    assert np.allclose(velocity[told], even, atol=0.01)
    assert np.allclose(change, 0.0, atol=0.01)


def swinging(steps: int, seed: int, first: int = 0) -> tuple[list[Array], Array]:
    """Steps with noise of 3 mm and 0.1 mrad of a scanner 2 m above the ground that swings from the first on; and by
    how much its travel changes a second at the stamps."""
    rng, t = np.random.default_rng(seed), 0.1 * np.arange(steps + 1)
    moves = np.maximum(t - t[first], 0.0)
    angle = 0.01 * np.sin(2 * np.pi * 1.5 * moves)
    poses = se3.matrix(np.stack([5 * moves, -2 * angle, 0 * t, angle, 0 * t, 0 * t], axis=1))
    vec = se3.vector(se3.relative(poses[:-1], poses[1:])) + rng.normal(0, np.repeat([3e-3, 1e-4], 3), (steps, 6))
    return [*se3.matrix(vec)], 2 * (2 * np.pi * 1.5) ** 2 * angle


@pytest.mark.parametrize(("steps", "first"), [(50, 0), (50, 30), (50, 40)])
def test_swing_is_told_by_turns_though_the_vehicle_stands_at_first(steps: int, first: int) -> None:
    found, true = swinging(steps, 1, first)
    _, change = derivatives(0.1 * np.arange(steps + 1), found)
    moving = slice(first + 3, -2)
    assert np.sqrt(np.mean((change[moving, 1] - true[moving]) ** 2)) < 0.25 * np.sqrt(np.mean(true[moving] ** 2))
    assert np.abs(change[:, 0]).max() < 1.0


@pytest.mark.parametrize("steps", [5, 6, 7, 8])
def test_few_steps_do_not_tell_travel_by_travel(steps: int) -> None:
    rng = np.random.default_rng(steps)
    for _ in range(50):
        vec = np.array([0.8, 0, 0, 0, 0, 0]) + rng.normal(0, np.repeat([3e-3, 1e-4], 3), (steps, 6))
        _, change = derivatives(0.1 * np.arange(steps + 1), [*se3.matrix(vec)])
        assert np.abs(change[:, :3]).max() * 0.05**2 / 2 < 5e-4


def test_a_shaken_sweep_is_settled() -> None:
    """Beyond any step: by 6 mm and 1.5 mrad at its ends, more than the sigma of that."""
    rng = np.random.default_rng(0)
    shake = np.array([0.0, 0.006, 0.004, 0.0015, -0.001, 0.0])
    still, shaken = (
        swept(street(5), lambda part, by=by: se3.matrix((2 * part[:, None]) ** 2 * by), rng, 0.01)
        for by in (0 * shake, shake)
    )
    onto = registration.surface(still.points.astype(float), 0.25)
    T, points = settled(onto, shaken.points.astype(float), shaken.times.astype(float), np.eye(4), 0.25, 0.2)
    assert np.abs(se3.vector(T)).max() < 1e-3
    assert np.abs(se3.vector(T)[3:]).max() < 1e-4
    residuals = registration.plane_residuals(onto, points, T, 0.2)
    before = registration.plane_residuals(onto, shaken.points.astype(float), np.eye(4), 0.2)
    assert np.median(np.abs(residuals.errors)) < 0.9 * np.median(np.abs(before.errors))
