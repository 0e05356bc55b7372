"""calibration.json: strict JSON, nulls for what is not known, and the same calibration when read back."""

import json
from dataclasses import replace

import numpy as np
import pytest

from calib_toolkit import se3
from calib_toolkit.errors import DataError
from calib_toolkit.result_file import calibration_dict, read_calibration, result_dict, write_result
from calib_toolkit.types import Calibration, Result, Undetermined


@pytest.fixture
def calibration():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(21, 21)) * 0.01
    C = A @ A.T
    C[:7] = C[:, :7] = 0.0
    determined = np.ones((3, 7), dtype=bool)
    determined[2, :3] = determined[1, 6] = False
    return Calibration(
        base="velo",
        names=("velo", "ins", "cam0"),
        T_base_sensor=se3.matrix([[0.0] * 6, [-0.8, 0.3, -0.8, 0.01, 0.02, 3.1], [0.3, 0.0, -0.1, -1.2, 1.2, -1.2]]),
        dt_base_sensor=np.array([0.0, 0.25, -0.004]),
        covariance=C,
        has_scale=np.array([True, True, False]),
        determined=determined,
        undetermined=(
            Undetermined({"cam0.x": 0.6, "cam0.y": 0.8}, "the position of cam0 was not determined: drive bends"),
            Undetermined({"ins.dt": 1.0}, "the clock of ins was not determined"),
        ),
        clock_skew=np.array([0.0, 1e-6, 0.0]),
        t_ref=12.5,
    )


@pytest.fixture
def result(calibration):
    return Result(
        calibration,
        {"timing": calibration},
        statistics={"common_steps": 12},
        warnings=("velo: 1 file missing",),
        configuration={"method": "paper", "duration": None},
    )


@pytest.fixture
def file(result, tmp_path):
    write_result(result, tmp_path / "calibration.json")
    return tmp_path / "calibration.json"


def test_what_is_read_back_is_what_was_written(calibration, file):
    back = read_calibration(file)
    assert (back.base, back.names, back.undetermined) == (
        calibration.base,
        calibration.names,
        calibration.undetermined,
    )
    np.testing.assert_array_equal(back.determined, calibration.determined)
    np.testing.assert_array_equal(back.has_scale, calibration.has_scale)
    np.testing.assert_array_equal(back.clock_skew, calibration.clock_skew)
    assert back.t_ref == calibration.t_ref
    np.testing.assert_array_equal(back.T_base_sensor[:2], calibration.T_base_sensor[:2])
    np.testing.assert_array_equal(back.T_base_sensor[2, :3, :3], calibration.T_base_sensor[2, :3, :3])
    np.testing.assert_array_equal(back.sigma, calibration.sigma)
    known = calibration.determined.ravel()
    kept = np.ix_(known, known)
    np.testing.assert_array_equal(back.covariance[kept], calibration.covariance[kept])
    assert calibration_dict(back) == calibration_dict(calibration)


def test_what_was_not_determined_is_null_and_never_a_number(file):
    d = json.loads(file.read_text())
    cam0, ins = d["sensors"]["cam0"], d["sensors"]["ins"]
    assert [row[3] for row in cam0["T_base_sensor"]] == [None, None, None, 1.0]
    assert all(isinstance(x, float) for row in cam0["T_base_sensor"] for x in row[:3])
    assert [cam0["sigma"][k] for k in ("x", "y", "z")] == [None] * 3
    assert ins["dt_base_sensor"] is None
    assert ins["sigma"]["dt"] is None
    order, matrix = d["covariance"]["order"], d["covariance"]["matrix"]
    for name in ("cam0.x", "cam0.y", "cam0.z", "ins.dt"):
        assert matrix[order.index(name)] == [None] * 21
        assert [row[order.index(name)] for row in matrix] == [None] * 21


def test_it_is_strict_json(result, tmp_path):
    strange = replace(result, statistics={"ratio": float("nan")})
    with pytest.raises(ValueError, match="JSON"):
        write_result(strange, tmp_path / "calibration.json")
    assert not (tmp_path / "calibration.json").exists()


def test_everything_of_a_result_is_there(result):
    d = result_dict(result)
    assert d["warnings"] == ["velo: 1 file missing"]
    assert d["statistics"] == {"common_steps": 12}
    assert d["configuration"] == {"method": "paper", "duration": None}
    assert d["stages"]["timing"] == {key: d[key] for key in d["stages"]["timing"]}
    assert "maps points in the sensor to the base" in d["convention"]
    assert d["versions"]["numpy"] == np.__version__


def test_an_older_result_is_replaced_as_a_whole(result, file):
    before = file.read_text()
    write_result(replace(result, warnings=()), file)
    assert json.loads(file.read_text())["warnings"] == []
    assert file.read_text() != before
    assert [f.name for f in file.parent.iterdir()] == ["calibration.json"]


def test_a_write_that_fails_leaves_the_older_result(result, file, monkeypatch):
    before = file.read_text()
    monkeypatch.setattr(json, "dumps", lambda *a, **k: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_result(result, file)
    assert file.read_text() == before


def damaged(change):
    def damage(text):
        d = json.loads(text)
        change(d)
        return json.dumps(d)

    return damage


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: text[: len(text) // 2],
        lambda text: "[]",
        lambda text: "3",
        lambda text: "null",
        lambda text: "[" * 100_000,
        damaged(lambda d: d.pop("sensors")),
        damaged(lambda d: d.update(sensors=[])),
        damaged(lambda d: d.update(sensors={})),
        damaged(lambda d: d.update(base="radar")),
        damaged(lambda d: d["sensors"].update(ins=3)),
        damaged(lambda d: d["sensors"]["ins"].pop("T_base_sensor")),
        damaged(lambda d: d["sensors"]["ins"]["sigma"].pop("dt")),
        damaged(lambda d: d["sensors"]["ins"].update(T_base_sensor=[[1, 2], [3, 4]])),
        damaged(lambda d: d["sensors"]["ins"].update(T_base_sensor="x")),
        damaged(
            lambda d: d["sensors"]["ins"].update(
                T_base_sensor=np.array(d["sensors"]["ins"]["T_base_sensor"]).T.tolist()
            )
        ),
        damaged(lambda d: d["sensors"]["ins"].update(clock_skew=float("nan"))),
        damaged(lambda d: d["sensors"]["ins"].update(t_ref=99.0)),
        damaged(lambda d: d["sensors"]["ins"].update(T_base_sensor=np.diag([1.0, 1.0, -1.0, 1.0]).tolist())),
        damaged(lambda d: d["sensors"]["ins"].update(T_base_sensor=[[None, 0, 0, 0], *np.eye(4)[1:].tolist()])),
        damaged(lambda d: d["covariance"].update(matrix=[[1.0]])),
        damaged(lambda d: d.update(undetermined=[3])),
    ],
)
def test_what_is_not_a_calibration_is_refused_by_name(file, damage):
    file.write_text(damage(file.read_text()))
    with pytest.raises(DataError, match=r"calibration\.json is not a calibration"):
        read_calibration(file)


def test_a_file_that_is_not_there_is_refused_by_name(tmp_path):
    with pytest.raises(DataError, match=r"none\.json"):
        read_calibration(tmp_path / "none.json")


def test_poses_alone_are_a_calibration(tmp_path):
    """A rig that someone measured: no sigma is exact, no offset is an offset not known."""
    file = tmp_path / "truth.json"
    pose = [[1, 0, 0, 0.5], [0, 1, 0, None], [0, 0, 1, 0.0], [0, 0, 0, 1]]
    sensors = {"velo": {"T_base_sensor": np.eye(4).tolist(), "dt_base_sensor": 0.0}, "ins": {"T_base_sensor": pose}}
    file.write_text(json.dumps({"base": "velo", "sensors": sensors}))
    read = read_calibration(file)
    assert read.determined.tolist() == [[True] * 7, [True, False, True, True, True, True, False]]
    assert np.all(read.sigma[read.determined] == 0.0)
    assert read.T_base_sensor[1, 0, 3] == 0.5
