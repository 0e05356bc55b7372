"""Odometry: the three file formats, noise told from motion, translations without scale."""

from pathlib import Path

import numpy as np
import pytest
from odometry_files import PERIOD_NS, SIGMA, START_NS, integrated, measured, noisy, opened, poses, written

from calib_toolkit import DataError, MotionReading, Motions, PoseReading, SensorTable, Stream, Trajectory, se3
from calib_toolkit.testing import FORWARD, STILL, TURNING, Drive
from calib_toolkit_plugins import odometry_tables
from calib_toolkit_plugins.odometry import NOISE_FLOOR, OdometryOptions, estimate, noise_of_steps, unit_translations


@pytest.mark.parametrize("style", ["tum", "kitti", "euroc"])
def test_poses_are_read_in_every_format_with_stamps_to_the_nanosecond(tmp_path: Path, style: str) -> None:
    T = poses(30)
    log = odometry_tables.open_table(SensorTable("slam", tmp_path, written(tmp_path, style, list(T))))
    stream = log.streams["slam"]
    assert log.epoch_ns == START_NS
    assert stream.stamps == pytest.approx(PERIOD_NS * 1e-9 * np.arange(30), abs=1e-12)
    assert np.array([r.T_world_sensor for r in stream.readings]) == pytest.approx(T, abs=1e-12)
    assert measured(stream).vec == pytest.approx(se3.vector(se3.relative(T[:-1], T[1:])), abs=1e-9)
    assert stream.notes == ()


def test_stated_sigmas_are_those_of_every_step(tmp_path: Path) -> None:
    table = written(tmp_path, "tum", list(poses(5)))
    stream = opened(tmp_path, table | {"motion_sigma": SIGMA.tolist()})
    assert measured(stream).cov == pytest.approx(np.tile(np.diag(SIGMA**2), (4, 1, 1)))


def test_sigmas_of_each_row_belong_to_the_step_that_ends_there(tmp_path: Path) -> None:
    table = written(tmp_path, "tum", list(poses(5))) | {"sigmas": "sigmas.txt"}
    rows = SIGMA * np.arange(1, 6)[:, None]
    np.savetxt(tmp_path / "sigmas.txt", rows)
    motions = measured(opened(tmp_path, table))
    assert np.sqrt(np.diagonal(motions.cov, axis1=1, axis2=2)) == pytest.approx(rows[1:])
    assert motions.vec == pytest.approx(se3.vector(se3.relative(poses(5)[:-1], poses(5)[1:])), abs=1e-9)


def test_sigmas_stay_with_their_rows_when_a_row_is_left_out(tmp_path: Path) -> None:
    table = written(tmp_path, "tum", list(poses(6))) | {"sigmas": "sigmas.txt"}
    lines = (tmp_path / "poses.txt").read_text().splitlines()
    lines[4] = lines[4].rsplit(" ", 1)[0] + " nan"
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    rows = SIGMA * np.arange(1, 7)[:, None]
    np.savetxt(tmp_path / "sigmas.txt", rows)
    motions = measured(opened(tmp_path, table))
    assert np.sqrt(np.diagonal(motions.cov, axis1=1, axis2=2)) == pytest.approx(rows[[1, 3, 4, 5]])


@pytest.mark.parametrize("drive", [FORWARD, TURNING], ids=lambda d: d.name)
def test_noise_is_told_from_the_motion_whatever_the_outliers(drive: Drive) -> None:
    motions = noisy(1500, drive=drive)
    assert noise_of_steps("slam", motions) == pytest.approx(SIGMA, rel=0.12)
    motions.vec[::25] += [3.0, 1.0, 1.0, 0.2, 0.2, 0.2]
    assert noise_of_steps("slam", motions) == pytest.approx(SIGMA, rel=0.35)


def test_standing_still_for_most_of_the_drive_does_not_hide_the_noise() -> None:
    drive, stop = noisy(400, drive=FORWARD), noisy(1200, drive=STILL)
    vec = np.concatenate([drive.vec[:200], 0.0 * stop.vec, drive.vec[200:]])
    stamps = 0.1 * np.arange(len(vec) + 1)
    motions = Motions(stamps[:-1], stamps[1:], vec, np.zeros((len(vec), 6, 6)))
    assert noise_of_steps("slam", motions) == pytest.approx(SIGMA, rel=0.2)


def test_a_gap_in_the_recording_is_not_noise() -> None:
    motions = noisy(1000, drive=FORWARD)
    kept = np.arange(1000) % 10 != 0
    assert noise_of_steps("slam", motions[kept]) == pytest.approx(SIGMA, rel=0.15)


def test_the_noise_of_a_table_is_that_of_the_whole_recording_in_every_slice(tmp_path: Path) -> None:
    table = written(tmp_path, "tum", integrated(noisy(400)))
    stream = opened(tmp_path, table)
    whole, part = measured(stream), measured(stream[100:103])
    assert np.array_equal(whole[100:102].cov, part.cov)
    assert np.sqrt(np.diag(part.cov[0])) == pytest.approx(SIGMA, rel=0.3)


def test_perfect_poses_are_not_believed_perfectly(tmp_path: Path) -> None:
    stream = opened(tmp_path, written(tmp_path, "tum", list(poses(40, STILL))))
    assert np.sqrt(np.diag(measured(stream).cov[0])) == pytest.approx(NOISE_FLOOR)


def test_translations_without_scale_get_length_one_and_the_spread_of_their_direction() -> None:
    t, n = np.array([1.5, 0.4, -0.2]), 200_000
    drawn = t + SIGMA[:3] * np.random.default_rng(1).standard_normal((n, 3))
    drawn /= np.linalg.norm(drawn, axis=1)[:, None]
    one = Motions(np.zeros(1), np.ones(1), np.r_[t, 0.1, 0.2, 0.3][None], np.diag(SIGMA**2)[None])
    found = unit_translations(one)
    assert not found.has_scale
    assert found.vec[0] == pytest.approx([*t / np.linalg.norm(t), 0.1, 0.2, 0.3])
    assert found.cov[0, :3, :3] == pytest.approx(np.cov(drawn.T), abs=3e-6)
    assert found.cov[0, 3:, 3:] == pytest.approx(np.diag(SIGMA[3:] ** 2))


def test_the_direction_of_no_translation_is_unknown() -> None:
    vec = np.array([[0, 0, 0, 0, 0, 0.1], [0.001, 0, 0, 0, 0, 0.1]])
    found = unit_translations(Motions(np.zeros(2), np.ones(2), vec, np.tile(np.diag(SIGMA**2), (2, 1, 1))))
    assert np.linalg.norm(found.vec[:, :3], axis=1) == pytest.approx(1.0)
    assert found.cov[0, :3, :3] == pytest.approx(np.eye(3))
    assert found.cov[1, :3, :3] == pytest.approx(np.diag([0.0, 1.0, 1.0]))
    assert found.cov[:, 5, 5] == pytest.approx(SIGMA[5] ** 2)


def test_scale_can_be_denied_by_the_table_and_by_the_options(tmp_path: Path) -> None:
    table = written(tmp_path, "tum", integrated(noisy(40)))
    by_table = opened(tmp_path, table | {"has_scale": False})
    assert not by_table.has_scale
    assert not measured(by_table).has_scale
    by_option = estimate(opened(tmp_path, table), OdometryOptions(has_scale=False))
    assert isinstance(by_option, Motions)
    assert np.linalg.norm(by_option.vec[:, :3], axis=1) == pytest.approx(1.0)


def test_poses_that_state_their_covariance_stay_a_trajectory() -> None:
    cov = np.diag(SIGMA**2)
    stream = Stream("slam", "odometry", np.arange(4.0), [PoseReading(T, cov) for T in poses(4)])
    found = estimate(stream, OdometryOptions())
    assert isinstance(found, Trajectory)
    assert np.array_equal(found.cov[2], cov)
    assert not found.drift.any()


def test_motions_that_failed_are_left_out() -> None:
    readings = [MotionReading(None)] + [
        MotionReading(None if k == 3 else np.full(6, 0.1 * k), np.diag(SIGMA**2)) for k in range(1, 6)
    ]
    found = estimate(Stream("vo", "odometry", np.arange(6.0), readings), OdometryOptions())
    assert isinstance(found, Motions)
    assert found.start.tolist() == [0.0, 1.0, 3.0, 4.0]
    assert found.end.tolist() == [1.0, 2.0, 4.0, 5.0]
    assert found.vec[:, 0] == pytest.approx([0.1, 0.2, 0.4, 0.5])


def test_readings_that_hold_no_numbers_are_refused_by_name_and_stamp() -> None:
    bad = np.r_[np.nan, np.zeros(5)]
    motions = [MotionReading(np.zeros(6), np.eye(6)), MotionReading(bad, np.eye(6))]
    with pytest.raises(DataError, match=r"sensor vo: its motion at 1\.000 s holds nan"):
        estimate(Stream("vo", "odometry", np.arange(2.0), motions), OdometryOptions())
    lost = [PoseReading(np.full((4, 4), np.nan) if k == 2 else np.eye(4)) for k in range(4)]
    with pytest.raises(DataError, match=r"sensor vo: its pose at 2\.000 s holds nan"):
        estimate(Stream("vo", "odometry", np.arange(4.0), lost), OdometryOptions())
    with pytest.raises(DataError, match="sensor vo: none of its 3 readings holds a motion"):
        estimate(Stream("vo", "odometry", np.arange(3.0), [MotionReading(None)] * 3), OdometryOptions())
    with pytest.raises(DataError, match=r"sensor vo: its 3 steps are too few .* state motion_sigma"):
        estimate(Stream("vo", "odometry", np.arange(4.0), [PoseReading(T) for T in poses(4)]), OdometryOptions())


def test_noise_of_real_odometry(recordings: Path) -> None:
    """A KITTI drive: the INS is smooth to 2 mm a step, KISS-ICP to 1-2 cm, and halves of the drive agree."""
    sigma = {}
    for file in ("ins_pose_tum.txt", "lidar_kissicp_pose_tum.txt"):
        table = {"kind": "odometry", "poses": file, "format": "tum"}
        stream = opened(recordings / "kitti-drive-0027", table)
        sigma[file] = np.array(stream.options["motion_sigma"])
        halves = [noise_of_steps(file, measured(part)) for part in (stream[:2271], stream[2270:])]
        assert np.all(np.abs(np.log(halves[0] / halves[1])) < np.log(1.5))
    ins, lidar = sigma.values()
    assert np.all((ins[:3] > 0.001) & (ins[:3] < 0.004))
    assert np.all((lidar[:3] > 0.005) & (lidar[:3] < 0.03))
