"""The simulated world: solid, the same every time, and never in the vehicle's way."""

import numpy as np
import pytest

from calib_toolkit_datasets.simulation.road import along
from calib_toolkit_datasets.simulation.scene import LAYOUTS, World, build
from calib_toolkit_datasets.simulation.surfaces import MATERIALS, Hits
from calib_toolkit_datasets.simulation.terrain import Terrain, terrain
from calib_toolkit_datasets.simulation.traffic import Mover
from calib_toolkit_datasets.simulation.vehicle import DRIVES, TruePath, path

DRIVE_OF = {"street": "street", "court": "court", "highway": "highway", "open": "street"}
SECONDS = 6.0
LIKE_STREET = ("rough", "planar", "straight", "highway")


@pytest.fixture(scope="module", params=LAYOUTS)
def place(request: pytest.FixtureRequest) -> tuple[str, TruePath, Terrain, World]:
    drive = DRIVE_OF[request.param]
    true, ground = path(SECONDS, 3, drive), terrain(3, drive)
    return request.param, true, ground, build(true, ground, request.param, 3)


def look(world: World, true: TruePath, stamp: float, height: float = 1.7) -> Hits:
    """What is seen all around from above the vehicle, from 25 degrees below the horizon to 15 above it."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 2)), np.radians(np.arange(-25, 16, 1)))
    a, e = azimuth.ravel(), elevation.ravel()
    directions = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    T = true.at(np.array([stamp]))[0]
    origins = np.tile(T[:3, 3] + [0, 0, height], (len(a), 1))
    return world.cast(origins, directions @ T[:3, :3].T, np.full(len(a), stamp))


def toward(world: World, origin: np.ndarray, target: np.ndarray, stamp: float) -> Hits:
    ray = target - origin
    return world.cast(origin[None], (ray / np.linalg.norm(ray))[None], np.array([stamp]))


def test_hits_are_well_formed(place, monkeypatch):
    _, true, _, world = place
    monkeypatch.setattr(world, "movers", [])
    T = true.at(np.array([SECONDS / 2]))[0]
    hits = look(world, true, SECONDS / 2)
    hit = np.isfinite(hits.distance)
    assert 0.3 < hit.mean() < 1.0
    for name in ("distance", "position", "normal", "normal_world", "tone"):
        assert getattr(hits, name).dtype == np.float32
        assert np.all(np.isfinite(getattr(hits, name)[hit]))
    assert hits.material.dtype == np.uint8
    assert hits.material[hit].max() < len(MATERIALS)
    assert hits.tone[hit].min() >= 0
    assert hits.tone[hit].max() <= 1
    np.testing.assert_allclose(np.linalg.norm(hits.normal_world[hit], axis=1), 1, atol=1e-5)
    np.testing.assert_array_equal(hits.normal, hits.normal_world)
    ray = hits.position[hit] - (T[:3, 3] + [0, 0, 1.7])
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), hits.distance[hit], atol=1e-3)
    assert np.einsum("ij,ij->i", ray, hits.normal_world[hit]).max() <= 1e-4


def test_nothing_stands_in_the_way(place):
    """Rays from a car's sides outwards, from its front ahead, and from the ground up to its roof, all along."""
    _, true, _, world = place
    stamps = np.arange(0.0, SECONDS, 0.05)
    T = true.at(stamps)
    for height in (0.4, 1.0, 1.9):
        for left, ahead in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
            direction = (T[:, :3, :3] @ [ahead, left, 0.0]).reshape(-1, 3)
            origins = T[:, :3, 3] + height * T[:, :3, 2]
            hits = world.cast(origins, direction, stamps)
            assert hits.distance.min() > (1.7 if left else 2.3)


def test_vehicle_drives_on_the_ground(place):
    name, true, ground, world = place
    stamps = np.arange(0.0, SECONDS, 0.02)
    xy = true.at(stamps)[:, :2, 3]
    down = np.tile([0.0, 0.0, -1.0], (len(xy), 1))
    hits = world.cast(np.column_stack([xy, ground.height(xy) + 2.0]), down, stamps)
    bare = hits.material != MATERIALS.index("marking")
    assert bare.mean() > 0.7
    coarse = name in ("highway", "open")
    np.testing.assert_allclose(hits.distance[bare], 2.0, atol=0.004 if coarse else 0.001)


def test_same_seed_same_hits():
    worlds = []
    for seed in (1, 1):
        true = path(2.0, 1, "street")
        worlds.append(look(build(true, terrain(1, "street"), "street", seed), true, 1.0))
    first, again = worlds
    for name in ("distance", "position", "normal_world", "material", "tone"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))


@pytest.mark.parametrize(
    "drive", [pytest.param(d, marks=pytest.mark.long) if d in LIKE_STREET else d for d in DRIVES]
)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_suits_every_drive(layout: str, drive: str):
    true = path(2.0, 5, drive)
    world = build(true, terrain(5, drive), layout, 5)
    assert np.isfinite(look(world, true, 1.0).distance).mean() > 0.3
    assert len(world) < 400_000


def test_layouts_look_different():
    near, sky = {}, {}
    for layout in LAYOUTS:
        true = path(2.0, 2, "straight")
        hits = look(build(true, terrain(2, "straight"), layout, 2), true, 1.0)
        hit = np.isfinite(hits.distance)
        near[layout], sky[layout] = float(np.mean(hits.distance[hit] < 25)), float(np.mean(~hit))
    assert sky["street"] < sky["open"]
    assert sky["court"] < sky["highway"]
    assert near["street"] > near["open"] + 0.05


def test_other_seed_other_place():
    true, ground = path(2.0, 1, "court"), terrain(1, "court")
    one, other = (look(build(true, ground, "court", seed), true, 1.0).distance for seed in (1, 2))
    assert np.mean(one != other) > 0.3


def test_no_such_layout():
    with pytest.raises(ValueError, match="no scene 'moon'"):
        build(path(1.0, 1), terrain(1, "street"), "moon", 1)


def test_moving_things_keep_clear_of_the_vehicle():
    for layout, drive, at_least in (("street", "street", 8), ("highway", "highway", 4), ("court", "court", 1)):
        true = path(15.0, 4, drive)
        world = build(true, terrain(4, drive), layout, 4)
        assert len(world.movers) >= at_least
        for mover in world.movers:
            stamps = np.arange(max(mover.start, -2.0), min(mover.end, 17.0), 0.05)
            T = true.at(stamps)
            gap = np.einsum("nji,nj->ni", T[:, :3, :3], mover.at(stamps)[:, :3] - T[:, :3, 3])
            # half a car each and half a metre between them; people within a step of the car's side at worst
            beside = 2.9 if mover.mesh < 4 else 2.1
            assert np.all((np.abs(gap[:, 0]) > 3.8) | (np.abs(gap[:, 1]) > beside))


def test_moving_car_is_where_it_is_at_the_instant_of_the_ray():
    """A lone car at 10 m/s on an empty plain, seen from its side at two instants and in its own axes."""
    from calib_toolkit_datasets.simulation import props
    from calib_toolkit_datasets.simulation.shapes import box

    plain = box([-100, -100, -1], [100, 100, 0], "grass")
    t = np.arange(0.0, 4.0, 0.1)
    poses = np.column_stack([10 * t - 20, 0 * t, 0 * t, 0 * t])
    world = World(plain, [props.car("saloon")], [Mover(0, 0.7, 0.0, poses)])
    # rays straight down from above: the car's length covers a window that moves with it
    x = np.arange(-30.0, 30.0, 0.01)
    front = []
    for stamp in (1.0, 1.52):
        origins = np.column_stack([x, 0 * x, 0 * x + 5.0])
        hits = world.cast(origins, np.tile([0.0, 0.0, -1.0], (len(x), 1)), np.full(len(x), stamp))
        on_car = hits.distance < 4.99
        assert hits.tone[on_car].min() == np.float32(0.7)
        np.testing.assert_allclose(hits.position[on_car, 0], x[on_car] - (10 * stamp - 20), atol=1e-4)
        front.append(x[on_car].max())
    assert front[1] - front[0] == pytest.approx(5.2, abs=0.021)
    # rays with stamps of their own see it drawn out by its motion during the sweep
    sweep = np.linspace(1.0, 1.1, len(x))
    hits = world.cast(np.column_stack([x, 0 * x, 0 * x + 5.0]), np.tile([0.0, 0.0, -1.0], (len(x), 1)), sweep)
    on_car = hits.distance < 4.99
    np.testing.assert_allclose(hits.position[on_car, 0], (x - (10 * sweep - 20))[on_car], atol=1e-4)


def test_cars_turn_with_their_heading():
    from calib_toolkit_datasets.simulation import props
    from calib_toolkit_datasets.simulation.shapes import box

    plain = box([-100, -100, -1], [100, 100, 0], "grass")
    poses = np.tile([3.0, 4.0, 0.0, np.pi / 2], (20, 1))
    world = World(plain, [props.car("van")], [Mover(0, 0.2, 0.0, poses)])
    hits = toward(world, np.array([-5.0, 4.0, 1.0]), np.array([3.0, 4.0, 1.0]), 0.5)
    np.testing.assert_allclose(hits.normal_world[0], [-1, 0, 0], atol=0.3)
    np.testing.assert_allclose(hits.normal[0], [0, 1, 0], atol=0.3)
    assert hits.distance[0] == pytest.approx(7.05, abs=0.1)


def test_a_car_at_rest_still_has_a_street():
    line = along(path(2.0, 1, "static"), 50.0)
    assert line.s[0] == pytest.approx(-50.0)
    assert line.s[-1] == pytest.approx(50.0, abs=0.6)
    np.testing.assert_allclose(line.xy[:, 1], 0.0, atol=1e-9)


@pytest.mark.long
def test_nothing_stands_in_the_way_of_a_long_drive():
    for seed in (1, 2, 3):
        true, ground = path(200.0, seed, "street"), terrain(seed, "street")
        test_nothing_stands_in_the_way(("street", true, ground, build(true, ground, "street", seed)))


def test_scattered_rays_meet_what_moves_as_a_single_ray_does():
    true = path(15.0, 4)
    world = build(true, terrain(4, "street"), "street", 4)
    mover = next(m for m in world.movers if m.end - m.start > 4.0)
    stamp = mover.start + 2.0
    below = mover.at(np.array([stamp]))[0, :3] + np.array([0.0, 0.0, 0.05])
    origins, up = below + np.array([[0.0, 0.0, 0.0], [300.0, 0.0, 30.0]]), np.array([[0.0, 0.0, 1.0]] * 2)
    alone = world.cast(origins[:1], up[:1], np.full(1, stamp)).distance[0]
    assert world.cast(origins, up, np.full(2, stamp)).distance[0] == alone < 2.5
