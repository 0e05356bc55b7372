"""The panorama of a ring of cameras, from its mean rotations."""

import numpy as np
import pytest
from recorded_drives import FAST, PAPER

from calib_toolkit import CameraIntrinsics, Log, Stream, se3
from calib_toolkit.evaluation import drives, experiment, panorama
from calib_toolkit.evaluation.measures import FORWARD_LEFT_UP
from calib_toolkit.evaluation.sections import Draw, cut
from calib_toolkit.progress import Silent


def sphere(directions):
    """A colour for each direction of the world."""
    yaw, up = np.arctan2(directions[..., 1], directions[..., 0]), directions[..., 2]
    channels = [128 + 100 * np.sin(3 * yaw), 128 + 100 * np.cos(2 * yaw + up), 128 + 100 * up]
    return np.clip(np.stack(channels, axis=-1), 0, 255).astype(np.uint8)


def views_of(R, K, size):
    """What ideal cameras at R (in the first one's axes) see of the sphere."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u, dtype=float)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return [sphere((rays @ r.T) @ FORWARD_LEFT_UP.T) for r in R]


def ring_of_five():
    turns = se3.exp_so3(np.radians(np.arange(0, 360, 72))[:, None] * [0.0, 1.0, 0.0])
    K = np.array([[150.0, 0, 160], [0, 150.0, 200], [0, 0, 1]])
    return turns, K, (320, 400)


@pytest.fixture
def small_panorama(monkeypatch):
    monkeypatch.setattr(panorama, "SIZE", (480, 240))


def test_a_panorama_from_true_rotations_is_the_sphere(small_panorama):
    R, K, size = ring_of_five()
    views = [(i, CameraIntrinsics(K), r) for i, r in zip(views_of(R, K, size), R, strict=True)]
    made = panorama.panorama(views).astype(float)
    expected = sphere(panorama._rays()).astype(float)
    level = slice(83, 157)  # all around the horizon there is a camera
    assert made[level].any(axis=-1).all()
    assert np.abs(made[level] - expected[level]).mean() < 1.5
    assert not made[:33].any()
    wrong = [(i, k, r @ se3.exp_so3(np.radians([0, 5.0, 0]))) for i, k, r in views]
    assert np.abs(panorama.panorama(wrong)[level] - expected[level]).mean() > 5


def test_the_mean_rotation_is_read_back_from_the_table(ring, tmp_path):
    done = experiment.run("panoramic", [ring], tmp_path, experiment.Choices(1, (50.0,), PAPER), FAST, Silent())
    names = list(ring.motions)
    rows = [r for r in done.rows if r["estimator"] == "paper-together"]
    R = panorama.mean_rotations(rows, names, ring.truth.T_base_sensor[:, :3, :3])
    for k, name in enumerate(names[1:], start=1):
        (row,) = [r for r in rows if r["sensor"] == f"cam0-{name}"]
        off = np.degrees(np.linalg.norm(se3.log_so3(ring.truth.T_base_sensor[k, :3, :3] @ R[k].T)))
        assert off == pytest.approx(float(row["rotation_deg"]), rel=1e-4)
    from calib_toolkit import calibrate_motions

    section = cut(Draw(0, 50.0, 0.0, 0), [ring], "panoramic", 0)
    there = calibrate_motions(section.motions, FAST, section.clocks).calibration.T_base_sensor[:, :3, :3]
    np.testing.assert_allclose(R, there, atol=1e-5)
    refused = [{**r, "status": "refused", "rx_deg": ""} for r in rows]
    assert panorama.mean_rotations(refused, names, ring.truth.T_base_sensor[:, :3, :3]) is None


def test_the_panorama_is_drawn_from_images_or_says_why_not(ring, tmp_path, small_panorama):
    done = experiment.run("panoramic", [ring], tmp_path, experiment.Choices(1, (20.0,), PAPER), FAST, Silent())
    sentence = panorama.draw(ring, done.rows, tmp_path / "panorama.png")
    assert sentence.startswith("no panorama: ")
    assert sentence.endswith("holds no images, only motions of cam0")
    assert not (tmp_path / "panorama.png").exists()

    _, K, size = ring_of_five()
    R = ring.truth.T_base_sensor[:, :3, :3]
    stamps = np.array([0.0, 30.0])
    seen = views_of(R, K, size)
    streams = {
        n: Stream(n, "monocular", stamps, [np.zeros_like(i), i], CameraIntrinsics(K), has_scale=False)
        for n, i in zip(ring.motions, seen, strict=True)
    }
    with_images = drives.Drive("d", Log(tmp_path, streams), ring.motions, ring.clocks, ring.truth)
    # the first method's, whoever else is in the table
    wild = [{**r, "estimator": "other-together", "rx_deg": ""} for r in done.rows]
    assert panorama.draw(with_images, [*done.rows, *wild], tmp_path / "panorama.png") == (
        "panorama of cam0, cam1, cam2: panorama.png"
    )
    sentence = panorama.draw(with_images, [*wild, *done.rows], tmp_path / "p.png")
    assert sentence == "no panorama: no repeat of other-together determined the rotation of every camera"
    blind = {n: Stream(n, "monocular", s.stamps, s.readings, has_scale=False) for n, s in streams.items()}
    without = drives.Drive("d", Log(tmp_path, blind), ring.motions, ring.clocks, ring.truth)
    assert "does not hold the intrinsics of cam0" in panorama.draw(without, done.rows, tmp_path / "p.png")
