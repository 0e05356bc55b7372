"""What the types promise: validation in sentences, slicing, and covariances that samples agree with."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calib_toolkit import se3
from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration, LazyReadings, Log, Motions, Stream, Trajectory
from calib_toolkit.types.calibration import PARAMETERS


def stream(stamps, name="velo", **more):
    return Stream(name, "velodyne", np.array(stamps, dtype=float), list(range(len(stamps))), **more)


def log(**streams):
    return Log(Path("drive"), {name: stream(stamps, name) for name, stamps in streams.items()})


def random_cov(rng, n, scale):
    A = rng.normal(size=(n, n))
    return scale**2 * (A @ A.T / n + 0.1 * np.eye(n))


def noisy(T, noise):
    return se3.rigid(se3.exp_so3(noise[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] + noise[..., :3])


def assert_covariance(samples, cov, tolerance=0.06):
    """Sample covariance within a tolerance, whitened so that every direction counts alike."""
    W = np.linalg.inv(np.linalg.cholesky(cov))
    assert_allclose(W @ np.cov(samples.T) @ W.T, np.eye(len(cov)), atol=tolerance)


# --- Stream and Log


@pytest.mark.parametrize(
    ("stamps", "sentence"),
    [
        (
            [0, 1, 1, 2],
            r"velo: the stamp of reading 2 \(1.000000 s\) does not come after .*\(1.000000 s\); drop or sort",
        ),
        ([0, 2, 1], r"velo: the stamp of reading 2 \(1.000000 s\) does not come after .*\(2.000000 s\)"),
        ([0, np.nan, 2], r"velo: the stamp of reading 1 is not a number; drop that reading"),
        ([np.inf], r"velo: the stamp of reading 0 is not a number"),
    ],
)
def test_bad_stamps_are_refused_by_name_and_number(stamps, sentence):
    with pytest.raises(DataError, match=sentence):
        stream(stamps)


def test_every_reading_needs_a_stamp():
    with pytest.raises(DataError, match=r"velo: 3 stamps for 2 readings"):
        Stream("velo", "velodyne", np.arange(3.0), [1, 2])


def test_a_stream_slices_stamps_and_readings_together():
    part = stream([0.0, 0.1, 0.2, 0.3])[1:3]
    assert_allclose(part.stamps, [0.1, 0.2])
    assert list(part.readings) == [1, 2]
    assert part.name == "velo"


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [(0.1, 0.3, [1, 2, 3]), (0.05, 0.25, [1, 2]), (0.4, 9, [4]), (5, 9, []), (-1, 0, [0]), (0.15, 0.15, [])],
)
def test_between_includes_both_ends(start, end, expected):
    assert list(stream([0.0, 0.1, 0.2, 0.3, 0.4]).between(start, end).readings) == expected


def test_period_is_the_median_step():
    assert stream([0, 1, 2, 9, 10]).period == 1.0
    assert np.isnan(stream([4]).period)
    assert np.isnan(stream([]).period)


def test_a_stream_has_a_clock_of_its_own_unless_told():
    assert stream([0, 1]).clock == "velo"
    assert stream([0, 1], clock="ladybug").clock == "ladybug"
    assert stream([0, 1], clock="ladybug")[:1].clock == "ladybug"


def test_select_keeps_the_order_asked_for():
    assert list(log(a=[0], b=[0], c=[0]).select(["c", "a"]).streams) == ["c", "a"]
    assert list(log(a=[0], b=[0]).select(None).streams) == ["a", "b"]


def test_select_names_the_sensors_there_are():
    with pytest.raises(DataError, match=r"drive has no sensor named 'cam9'; it has: velo, ins"):
        log(velo=[0], ins=[0]).select(["velo", "cam9"])
    with pytest.raises(DataError, match=r"sensor 'velo' is named twice"):
        log(velo=[0], ins=[0]).select(["velo", "velo"])


def test_trim_counts_from_the_first_stamp_of_any_sensor():
    part = log(a=[10, 11, 12, 13], b=[10.5, 11.5, 12.5]).trim(start=1, duration=1.5)
    assert_allclose(part.streams["a"].stamps, [11, 12])
    assert_allclose(part.streams["b"].stamps, [11.5, 12.5])
    assert_allclose(log(a=[10, 11, 12]).trim(start=1).streams["a"].stamps, [11, 12])


def test_lazy_readings_load_only_what_is_asked_for():
    loaded = []
    readings = LazyReadings(lambda key: loaded.append(key) or key.upper(), ["a", "b", "c", "d"])
    tail = readings[1:]
    assert (len(tail), loaded) == (3, [])
    assert tail[1] == "C"
    assert loaded == ["c"]


# --- Motions and Trajectory


def some_motions(n=5, t0=0.0, has_scale=True):
    stamps = t0 + np.arange(n + 1.0)
    vec = np.random.default_rng(n).normal(0, 0.1, (n, 6))
    return Motions(stamps[:-1], stamps[1:], vec, np.tile(np.eye(6), (n, 1, 1)), has_scale)


@pytest.mark.parametrize("column", ["end", "vec", "cov"])
def test_motions_of_the_wrong_shape_are_refused(column):
    m = some_motions()
    columns = {"start": m.start, "end": m.end, "vec": m.vec, "cov": m.cov}
    with pytest.raises(ValueError, match=rf"Motions.{column} has shape"):
        Motions(**columns | {column: columns[column][1:]})


def test_motions_index_by_slice_and_mask():
    m = some_motions()
    assert_allclose(m[1:3].vec, m.vec[1:3])
    assert_allclose(m[m.start > 2].start, [3, 4])
    assert not some_motions(has_scale=False)[:2].has_scale


def test_motions_concatenate_and_shift():
    both = Motions.concatenate([some_motions(2), some_motions(3, t0=10)])
    assert_allclose(both.start, [0, 1, 10, 11, 12])
    assert_allclose(both.shifted(0.5).end, both.end + 0.5)
    assert not Motions.concatenate([some_motions(2), some_motions(2, has_scale=False)]).has_scale


def some_trajectory(n=4, seed=0):
    rng = np.random.default_rng(seed)
    poses = se3.matrix(np.concatenate([rng.normal(0, 3, (n, 3)), rng.uniform(-1, 1, (n, 3))], axis=1))
    cov = np.array([random_cov(rng, 6, 1e-3) for _ in range(n)])
    drift = np.array([random_cov(rng, 6, 1e-3) for _ in range(n)])
    drift[0] = 0
    return Trajectory(np.arange(n) / 10, poses, cov, drift)


def test_trajectory_parts_join_at_the_pose_they_share():
    whole = some_trajectory(6)
    columns = (whole.stamps, whole.T_world_sensor, whole.cov, whole.drift)
    parts = [Trajectory(*(c[part] for c in columns)) for part in (slice(0, 3), slice(2, 4), slice(3, 6))]
    joined = Trajectory.concatenate(parts)
    for mine, theirs in zip((joined.stamps, joined.T_world_sensor, joined.cov, joined.drift), columns, strict=True):
        assert_allclose(mine, theirs)


def test_motions_of_a_trajectory_lead_from_pose_to_pose():
    trajectory = some_trajectory()
    motions = trajectory.motions()
    assert len(motions) == len(trajectory) - 1
    assert_allclose(
        trajectory.T_world_sensor[:-1] @ se3.matrix(motions.vec), trajectory.T_world_sensor[1:], atol=1e-9
    )
    assert_allclose((motions.start, motions.end), (trajectory.stamps[:-1], trajectory.stamps[1:]))


def test_covariance_of_a_trajectorys_motions_against_monte_carlo():
    trajectory, rng, n = some_trajectory(), np.random.default_rng(1), 20_000
    motions = trajectory.motions()
    for k in range(len(motions)):
        a, b = (
            noisy(trajectory.T_world_sensor[i], rng.multivariate_normal(np.zeros(6), trajectory.cov[i], n))
            for i in (k, k + 1)
        )
        drift = rng.multivariate_normal(np.zeros(6), trajectory.drift[k + 1], n)
        vec = se3.vector(noisy(se3.relative(a, b), drift))
        assert_covariance(vec, motions.cov[k])


# --- Calibration


def some_calibration(seed=0, determined=True):
    rng = np.random.default_rng(seed)
    vec = np.concatenate([rng.normal(0, 2, (3, 3)), rng.uniform(-1.5, 1.5, (3, 3))], axis=1)
    vec[0] = 0
    cov = np.zeros((21, 21))
    cov[7:, 7:] = random_cov(rng, 14, 1e-3)
    return Calibration(
        base="velo",
        names=("velo", "cam0", "ins"),
        T_base_sensor=se3.matrix(vec),
        dt_base_sensor=np.array([0.0, 0.02, -0.05]),
        covariance=cov,
        has_scale=np.array([True, False, True]),
        determined=np.full((3, 7), determined),
    )


def test_between_completes_the_chain_and_inverts():
    rig = some_calibration()
    T = {(a, b): rig.between(a, b).T_a_b for a in rig.names for b in rig.names}
    assert_allclose(T["velo", "cam0"], rig.T_base_sensor[1])
    assert_allclose(T["velo", "cam0"] @ T["cam0", "ins"], T["velo", "ins"], atol=1e-12)
    assert_allclose(T["ins", "cam0"], se3.invert(T["cam0", "ins"]), atol=1e-12)


def test_a_sensor_is_where_it_is_without_doubt():
    same = some_calibration().between("cam0", "cam0")
    assert_allclose(same.T_a_b, np.eye(4), atol=1e-12)
    assert_allclose(same.cov, 0, atol=1e-18)


def test_from_the_base_the_covariance_is_the_one_stated():
    rig = some_calibration()
    assert_allclose(rig.between("velo", "ins").cov, rig.covariance[14:20, 14:20], atol=1e-15)


@pytest.mark.parametrize(("a", "b"), [("cam0", "ins"), ("ins", "cam0"), ("ins", "velo")])
def test_covariance_between_sensors_against_monte_carlo(a, b):
    rig, rng, n = some_calibration(), np.random.default_rng(2), 20_000
    noise = np.zeros((n, 21))
    noise[:, 7:] = rng.multivariate_normal(np.zeros(14), rig.covariance[7:, 7:], n)
    noise = noise.reshape(n, 3, 7)[..., :6]
    T_w_a, T_w_b = (noisy(rig.T_base_sensor[i], noise[:, i]) for i in (rig.index(a), rig.index(b)))
    T_true, estimate = se3.relative(T_w_a, T_w_b), rig.between(a, b)
    delta = se3.log_so3(T_true[:, :3, :3] @ estimate.T_a_b[:3, :3].T)
    error = np.concatenate([T_true[:, :3, 3] - estimate.T_a_b[:3, 3], delta], axis=1)
    assert_covariance(error, estimate.cov)


def test_clock_offsets_between_sensors_against_monte_carlo():
    rig, rng = some_calibration(), np.random.default_rng(3)
    dt, sigma = rig.dt_between("cam0", "ins")
    assert dt == pytest.approx(-0.07)
    noise = rng.multivariate_normal(np.zeros(21), rig.covariance, 20_000)
    assert sigma == pytest.approx(np.std(noise[:, 20] - noise[:, 13]), rel=0.03)
    assert rig.dt_between("ins", "cam0") == (pytest.approx(0.07), pytest.approx(sigma))


def test_sigma_is_nan_where_the_drive_determines_nothing():
    rig = some_calibration()
    rig.determined[2, PARAMETERS.index("z")] = False
    assert np.isnan(rig.sigma[2, 2])
    assert np.isnan(rig.sigma).sum() == 1
    assert_allclose(rig.sigma[1], np.sqrt(np.diag(rig.covariance)[7:14]))
    assert not rig.between("cam0", "ins").has_scale
    assert rig.between("velo", "cam0").has_scale


def test_clocks_run_true_until_estimated():
    assert_allclose(some_calibration().clock_skew, np.zeros(3))


def test_clocks_that_drift_are_apart_by_more_later():
    two = Calibration(
        "a",
        ("a", "b"),
        np.array([np.eye(4)] * 2),
        np.array([0.0, 0.02]),
        np.zeros((14, 14)),
        np.array([True, True]),
        np.ones((2, 7), dtype=bool),
        clock_skew=np.array([0.0, 1e-3]),
        t_ref=10.0,
    )
    assert two.dt_at("a", "b", 60.0) == pytest.approx(0.07)
    assert two.dt_at("b", "a", 60.0) == pytest.approx(-0.07)
