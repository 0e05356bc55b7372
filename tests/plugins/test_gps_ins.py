"""GPS/INS: earth coordinates, covariance against brute force, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import DataError, Fix, SensorTable, Stream, Trajectory, se3
from calib_toolkit_plugins import gps_ins
from calib_toolkit_plugins.gps_ins import GpsInsOptions, ecef, enu_axes, estimate

Array = NDArray[np.float64]

HEADER = "stamp,lat_deg,lon_deg,alt,roll_deg,pitch_deg,yaw_deg"
KARLSRUHE = (np.deg2rad(49.0), np.deg2rad(8.4), 115.0)


def fix(east: float = 0.0, north: float = 0.0, up: float = 0.0, rpy: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Fix:
    """A fix some metres from Karlsruhe, by the radii of curvature there."""
    lat, lon, alt = KARLSRUHE
    e2 = gps_ins.FLATTENING * (2 - gps_ins.FLATTENING)
    w = np.sqrt(1 - e2 * np.sin(lat) ** 2)
    meridian = gps_ins.SEMI_MAJOR_AXIS * (1 - e2) / w**3 + alt
    parallel = (gps_ins.SEMI_MAJOR_AXIS / w + alt) * np.cos(lat)
    return Fix(lat + north / meridian, lon + east / parallel, alt + up, *rpy)


def stream(*fixes: Fix, period: float = 0.1) -> Stream:
    return Stream("ins", "gps_ins", period * np.arange(len(fixes)), list(fixes))


@pytest.mark.parametrize(
    ("lat", "lon", "alt", "xyz"),
    [
        (0, 0, 0, (6378137.0, 0, 0)),
        (0, 90, 100, (0, 6378237.0, 0)),
        (90, 0, 0, (0, 0, 6356752.314245)),
        (-90, 0, 10, (0, 0, -6356762.314245)),
    ],
)
def test_geodetic_coordinates_become_earth_centred_ones(
    lat: float, lon: float, alt: float, xyz: tuple[float]
) -> None:
    found = ecef(np.deg2rad([lat]), np.deg2rad([lon]), np.array([alt]))[0]
    assert found == pytest.approx(xyz, abs=2e-3)


def test_positions_lie_on_the_ellipsoid_and_up_is_its_normal() -> None:
    lat, lon = np.deg2rad([[46.0, -33.9, 71.2], [7.0, 151.2, -156.8]])
    surface = ecef(lat, lon, np.zeros(3))
    a, b = gps_ins.SEMI_MAJOR_AXIS, gps_ins.SEMI_MAJOR_AXIS * (1 - gps_ins.FLATTENING)
    assert np.sum((surface / [a, a, b]) ** 2, axis=1) == pytest.approx(1.0, abs=1e-12)
    normal = surface / np.array([a, a, b]) ** 2
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert (ecef(lat, lon, np.full(3, 500.0)) - surface) / 500.0 == pytest.approx(normal, abs=1e-10)
    assert enu_axes(lat, lon)[:, :, 2] == pytest.approx(normal, abs=1e-12)


def test_east_north_up_are_the_directions_in_which_the_coordinates_grow() -> None:
    lat, lon, alt = (np.array([v]) for v in KARLSRUHE)
    columns = [ecef(lat, lon + 1e-7, alt), ecef(lat + 1e-7, lon, alt), ecef(lat, lon, alt + 1.0)]
    grown = np.stack([(c - ecef(lat, lon, alt))[0] for c in columns], axis=1)
    assert enu_axes(lat, lon)[0] == pytest.approx(grown / np.linalg.norm(grown, axis=0), abs=1e-6)


def test_yaw_zero_faces_east_and_roll_pitch_yaw_turn_in_that_order() -> None:
    rpy = (0.1, -0.2, 0.7)
    found = estimate(stream(fix(), fix(rpy=rpy), fix(east=3.0)), GpsInsOptions()).motions()
    assert found.vec[0, 3:] == pytest.approx(Rotation.from_euler("xyz", rpy).as_rotvec(), abs=1e-9)
    ahead = estimate(stream(fix(), fix(east=3.0)), GpsInsOptions()).motions()
    assert ahead.vec[0] == pytest.approx([3.0, 0, 0, 0, 0, 0], abs=1e-5)


def test_a_north_bound_sensor_moves_along_its_own_x() -> None:
    heading = (0.0, 0.0, np.pi / 2)
    found = estimate(stream(fix(rpy=heading), fix(north=2.0, rpy=heading)), GpsInsOptions()).motions()
    assert found.vec[0] == pytest.approx([2.0, 0, 0, 0, 0, 0], abs=1e-5)


@pytest.mark.parametrize(
    "attitude", [(0.02, -0.03, 0.4), (1.2, 1.1, -2.6), (-2.9, -0.9, 3.1)], ids=["level", "steep", "overturned"]
)
def test_the_covariance_of_relative_motion_is_that_of_brute_force(attitude: tuple[float, float, float]) -> None:
    """Two fixes sampled 1e5 times, each motion by composition: the covariance of ``Motions.vec`` itself."""
    sigma_position, sigma_rpy = np.array([0.05, 0.08, 0.15]), np.deg2rad([0.3, 0.2, 0.5])
    turn = np.array([0.02, -0.03, 0.15])
    rpy = [np.array(attitude), np.array(attitude) + turn]
    pair = [fix(rpy=tuple(rpy[0])), fix(1.2, 0.4, 0.1, tuple(rpy[1]))]
    pair = [replace(f, sigma_position=sigma_position, sigma_rpy=sigma_rpy) for f in pair]
    claimed = estimate(stream(*pair), GpsInsOptions()).motions()

    rng, n = np.random.default_rng(3), 100_000
    T_enu_sensor = []
    for position, angles in zip(np.array([[0, 0, 0], [1.2, 0.4, 0.1]]), rpy, strict=True):
        drawn = angles + sigma_rpy * rng.standard_normal((n, 3))
        R = Rotation.from_euler("ZYX", drawn[:, ::-1]).as_matrix()
        T_enu_sensor.append(se3.rigid(R, position + sigma_position * rng.standard_normal((n, 3))))
    drawn_vec = se3.vector(se3.relative(*T_enu_sensor))
    brute = np.cov(drawn_vec.T)
    scale = np.sqrt(np.diag(brute))
    # the correlation of 1e5 draws is uncertain by 0.003; 0.02 leaves room for the angles' own bending
    assert claimed.cov[0] / np.outer(scale, scale) == pytest.approx(brute / np.outer(scale, scale), abs=0.02)
    assert claimed.vec[0] == pytest.approx(drawn_vec.mean(axis=0), abs=1e-3)


def test_a_fix_without_accuracy_gets_the_options_and_zero_counts_as_none() -> None:
    options = GpsInsOptions(sigma_position=0.2, sigma_rpy_deg=0.5)
    silent = estimate(stream(fix(), fix(east=1.0)), options)
    zero = replace(fix(), sigma_position=np.zeros(3), sigma_rpy=np.zeros(3))
    assert np.array_equal(silent.cov[0], estimate(stream(zero, fix(east=1.0)), options).cov[0])
    sigma = np.sqrt(np.linalg.eigvalsh(silent.cov[0]))
    assert sigma == pytest.approx([np.deg2rad(0.5)] * 3 + [0.2] * 3, rel=1e-3)


def test_slices_far_apart_share_one_world() -> None:
    fixes = [fix(east=1.0 * k, rpy=(0.0, 0.0, 0.01 * k)) for k in range(20)]
    whole = estimate(stream(*fixes), GpsInsOptions())
    parts = [estimate(stream(*fixes)[i : i + 8], GpsInsOptions()) for i in (0, 7, 14)]
    assert np.array_equal(Trajectory.concatenate(parts).T_world_sensor, whole.T_world_sensor)
    assert np.array_equal(Trajectory.concatenate(parts).cov, whole.cov)


def test_a_jump_of_the_solution_weighs_nothing_and_its_neighbours_keep_their_weight() -> None:
    fixes = [fix(east=1.0 * k + (300.0 if k >= 5 else 0.0)) for k in range(10)]
    motions = estimate(stream(*fixes), GpsInsOptions()).motions()
    sigma = np.sqrt(np.diagonal(motions.cov, axis1=1, axis2=2))
    assert np.all(sigma[4, :3] > 300.0)
    assert np.all(np.delete(sigma, 4, axis=0)[:, :3] < 0.2)
    fast = estimate(stream(*fixes), GpsInsOptions(max_speed=4000.0)).motions()
    assert np.all(np.sqrt(fast.cov[4, 0, 0]) < 0.2)


@pytest.mark.parametrize(
    ("bad", "sentence"),
    [
        (replace(fix(), alt=np.nan), "fix 2 at 0.200 s holds nan"),
        (replace(fix(), yaw=np.inf), "fix 2 at 0.200 s holds nan"),
        (replace(fix(), lat=49.0), "angles are in radians"),
        (replace(fix(), yaw=270.0), "angles are in radians"),
        (replace(fix(), sigma_rpy=np.array([0.1, -0.1, 0.1])), "sigma that is not positive"),
        (replace(fix(), sigma_position=np.array([0.1, np.nan, 0.1])), "sigma that is not positive"),
    ],
    ids=["nan", "inf", "latitude in degrees", "yaw in degrees", "negative sigma", "nan sigma"],
)
def test_what_can_not_be_a_fix_is_refused(bad: Fix, sentence: str) -> None:
    with pytest.raises(DataError, match=f"sensor ins: .*{sentence}"):
        estimate(stream(fix(), fix(east=1.0), bad), GpsInsOptions())


def test_a_table_of_fixes_is_read_to_the_nanosecond(tmp_path: Path) -> None:
    rows = [
        "1317646534.939040123,49,8.4,115,1,2,90,0.1,0.2,0.3,0.5,0.5,1",
        "1317646535.5,49,8.4,115,1,2,91,1,1,1,1,1,1",
    ]
    columns = HEADER + ",sigma_east,sigma_north,sigma_up,sigma_roll_deg,sigma_pitch_deg,sigma_yaw_deg"
    (tmp_path / "fixes.csv").write_text("\n".join([columns, *rows]))
    log = gps_ins.open_table(SensorTable("ins", tmp_path, {"kind": "gps_ins", "fixes": "fixes.csv"}))
    assert log.epoch_ns == 1317646534939040123
    assert log.streams["ins"].stamps == pytest.approx([0.0, 0.560959877], abs=1e-9)
    first = log.streams["ins"].readings[0]
    assert np.rad2deg([first.lat, first.lon, first.roll, first.pitch, first.yaw]) == pytest.approx(
        [49, 8.4, 1, 2, 90]
    )
    assert (first.alt, *first.sigma_position) == (115, 0.1, 0.2, 0.3)
    assert np.rad2deg(first.sigma_rpy) == pytest.approx([0.5, 0.5, 1.0])


def test_rows_that_can_not_be_used_are_left_out_with_a_note(tmp_path: Path) -> None:
    rows = [
        "1,49,8.4,115,0,0,0",
        "1.1,nan,8.4,115,0,0,0",
        "1.2,49,8.4,115,0,0,0",
        "1.15,49,8.4,115,0,0,0",
        "1.3,49,8.4,115,0,0,0",
    ]
    (tmp_path / "fixes.csv").write_text("\n".join([HEADER, *rows, ""]))
    found = gps_ins.open_table(SensorTable("ins", tmp_path, {"fixes": "fixes.csv"})).streams["ins"]
    assert found.stamps == pytest.approx([0.0, 0.2, 0.3])
    assert [r.sigma_position for r in found.readings] == [None] * 3
    assert ["line 3" in n or "line 5" in n for n in found.notes] == [True, True]


def test_where_a_table_was_cut_short_is_said(tmp_path: Path) -> None:
    whole = "\n".join([HEADER, *(f"{k},49,8.4,115,0,0,0.25" for k in range(1, 5))]) + "\n"
    notes = {}
    for cut in (0, 1, 6):
        (tmp_path / "fixes.csv").write_text(whole[: len(whole) - cut])
        found = gps_ins.open_table(SensorTable("ins", tmp_path, {"fixes": "fixes.csv"})).streams["ins"]
        assert len(found) == (3 if cut == 6 else 4)
        notes[cut] = found.notes
    within = (
        f"{tmp_path / 'fixes.csv'} ends in the middle of a line, as if cut short; its last number may be wrong",
    )
    assert notes[0] == ()
    assert notes[1] == within
    (note,) = notes[6]
    assert "fixes.csv, line 5 has fewer columns than the line before it" in note


def test_a_table_without_angles_is_of_positions_alone(tmp_path: Path) -> None:
    header = "stamp,lat_deg,lon_deg,alt,sigma_east,sigma_north,sigma_up"
    rows = [f"{0.1 * k:.1f},49.0,{8.4 + 1e-5 * k},115,0.5,0.5,1.0" for k in range(4)]
    (tmp_path / "fixes.csv").write_text("\n".join([header, *rows]))
    found = gps_ins.open_table(SensorTable("gnss", tmp_path, {"fixes": "fixes.csv"})).streams["gnss"]
    trajectory = estimate(found, GpsInsOptions())
    assert not trajectory.has_attitude
    step = np.linalg.norm(np.diff(trajectory.T_world_sensor[:, :3, 3], axis=0), axis=1)
    assert step == pytest.approx(np.full(3, 0.7319), abs=1e-3)
    assert np.trace(trajectory.cov[0, :3, :3]) == pytest.approx(0.5**2 + 0.5**2 + 1.0)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1,49,8.4,115,0,0,0\n2,49,8.4,115,0,0,0", "its first line must be stamp,lat_deg"),
        (HEADER.replace("lat_deg,lon_deg", "lon_deg,lat_deg") + "\n1,8.4,49,115,0,0,0", "its first line must be"),
        (HEADER, "holds no rows below its titles"),
        (HEADER + "\n1,49,8.4,115,0,0,0\n2,49,8.4,115,0,0\n3,49,8.4,115,0,0,0", "line 3: 6 columns where"),
        (HEADER + "\n1,49,8.4,115,0,0,north", "line 2: could not convert string to float: 'north'"),
    ],
    ids=["no header", "columns swapped", "empty", "too few columns", "words"],
)
def test_a_table_that_is_not_of_fixes_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "fixes.csv").write_text(text)
    with pytest.raises(DataError, match=sentence):
        gps_ins.open_table(SensorTable("ins", tmp_path, {"fixes": "fixes.csv"}))
