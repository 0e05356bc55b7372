"""An experiment and its table on disk: repeated, cut, completed, refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from builders import INS, LIDAR, drive
from recorded_drives import FAST, PAPER, a_drive, run, sensor

from calib_toolkit import Log
from calib_toolkit.config import METHODS
from calib_toolkit.errors import DataError
from calib_toolkit.evaluation import drives, experiment, measures, summary
from calib_toolkit.evaluation.protocols import PROTOCOLS
from calib_toolkit.evaluation.store import Store
from calib_toolkit.progress import Silent
from calib_toolkit_datasets.simulated import path, truth


def test_every_repeat_has_its_rows(two, tmp_path):
    done = experiment.run("pair", [two], tmp_path, experiment.Choices(3, (20.0,)), FAST, Silent())
    expected = [(str(k), m) for k in range(3) for m in (*METHODS, "least-squares")]
    assert [(r["repeat"], r["estimator"]) for r in done.rows] == expected
    lines = (tmp_path / "pair.csv").read_text().splitlines()
    assert len(lines) == 1 + len(expected)
    assert tuple(lines[0].split(",")) == experiment.columns(PROTOCOLS["pair"])
    assert {r["status"] for r in done.rows} == {"found"}
    settings = json.loads((tmp_path / "pair.json").read_text())
    assert settings["repeats"] == 3
    assert settings["sensors"] == ["velo", "ins"]
    assert settings["methods"] == list(METHODS)
    assert "jobs" not in json.dumps(settings)


def test_a_cut_table_is_completed_to_the_same_bytes(two, tmp_path):
    run(two, tmp_path)
    file = tmp_path / "pair.csv"
    whole = file.read_bytes()
    lines = whole.splitlines(keepends=True)
    worked = []

    class Watching(Silent):
        def begin(self, task, total, done=0):
            worked.append(total - done)

    for left in (
        b"",
        lines[0],
        b"".join(lines[:3]),
        b"".join([lines[0], *lines[5:7], lines[3], lines[4][:30]]),  # out of order, cut inside a number
        b"".join(lines[:-1]) + lines[-1].rstrip(b"\n"),
        whole,
    ):
        file.write_bytes(left)
        experiment.run("pair", [two], tmp_path, experiment.Choices(3, (20.0,), PAPER), FAST, Watching())
        assert file.read_bytes() == whole
    assert worked == [3, 3, 2, 2, 1, 0]


def test_finished_rows_are_taken_as_they_are(two, tmp_path):
    run(two, tmp_path)
    file = tmp_path / "pair.csv"
    rows = file.read_text().splitlines()
    marked = rows[1].split(",")
    marked[9] = "123.456"
    file.write_text("\n".join([rows[0], ",".join(marked), *rows[2:]]) + "\n")
    assert "123.456" in [v for r in run(two, tmp_path).rows for v in r.values()]


def test_other_settings_are_refused(two, tmp_path):
    run(two, tmp_path)
    before = (tmp_path / "pair.csv").read_bytes()
    for changed, sentence in (
        ({"repeats": 4}, "pair.csv was begun with repeats = 3, and this is 4; give the same, or choose another"),
        ({"seed": 1}, "begun with seed = 0, and this is 1"),
        ({"seconds": (21.0,)}, r"begun with seconds = \[20.0\], and this is \[21.0\]"),
    ):
        with pytest.raises(DataError, match=sentence):
            run(two, tmp_path, **changed)
    other = a_drive([sensor("velo", LIDAR), sensor("ins", INS)], seed=4)
    with pytest.raises(DataError, match="begun with motions = "):
        run(other, tmp_path)
    turned = replace(two, truth=replace(two.truth, dt_base_sensor=two.truth.dt_base_sensor + 0.001))
    with pytest.raises(DataError, match="begun with truth = "):
        run(turned, tmp_path)
    assert (tmp_path / "pair.csv").read_bytes() == before


def test_a_table_of_unknown_settings_is_refused(two, tmp_path):
    (tmp_path / "pair.csv").write_text("drive\n")
    with pytest.raises(DataError, match=r"pair\.csv is there without its settings pair\.json"):
        run(two, tmp_path)
    (tmp_path / "pair.json").write_text("{")
    with pytest.raises(DataError, match=r"pair\.json can not be read"):
        run(two, tmp_path)


def test_a_table_with_other_columns_is_refused(tmp_path):
    Store(tmp_path, "t", {}, ["a", "b"]).rewrite([{"a": "1", "b": "2"}])
    with pytest.raises(DataError, match="has other columns"):
        Store(tmp_path, "t", {}, ["a", "c"]).read()


def test_rows_survive_commas_quotes_and_letters(tmp_path):
    store = Store(tmp_path, "t", {}, ["a", "note"])
    rows = [{"a": "1", "note": 'a "b", c; µ'}, {"a": "2", "note": ""}]
    store.rewrite(rows)
    store.append([{"a": "3", "note": "x"}])
    assert store.read() == [*rows, {"a": "3", "note": "x"}]
    with store.table.open("ab") as file:
        file.write("4,µ".encode()[:-1])  # half a letter
    assert len(store.read()) == 3


def test_a_refusal_is_a_row(tmp_path):
    sensors = [sensor("velo", LIDAR), sensor("ins", INS)]
    still = drives.Drive(
        "still", Log(tmp_path, {}), drive(path(40.0, 3, "static"), sensors, 3), ("velo", "ins"), truth(sensors)
    )
    rows = run(still, tmp_path, repeats=2).rows
    assert {r["status"] for r in rows} == {"refused"}
    assert len(rows) == 4
    assert all(len(r["note"]) > 20 and not r["rotation_deg"] for r in rows)
    text = summary.markdown("pair", experiment.Outcome(rows, [], {20.0: 1}))
    assert "4 rows from still, 4 of them refused" in text
    assert "independent, at most: 1 of 20 s." in text
    assert f"- 2 x paper: {rows[0]['note']}" in text


def test_what_nobody_foresaw_is_a_row_too(two, tmp_path, monkeypatch):
    true = measures.calibrate_motions
    times = iter(range(3))

    def failing(*arguments):
        if next(times) == 1:
            raise np.linalg.LinAlgError("SVD did not converge")
        return true(*arguments)

    monkeypatch.setattr(measures, "calibrate_motions", failing)
    rows = run(two, tmp_path).rows
    assert [r["status"] for r in rows] == ["found", "found", "refused", "found", "found", "found"]
    assert rows[2]["note"] == "unexpected LinAlgError: SVD did not converge"


def test_what_nobody_foresaw_outside_of_the_methods_costs_one_repeat(two, tmp_path, monkeypatch):
    true = measures.rotation_error
    times = iter(range(6))  # of the method and of least squares, in three repeats, were it not for the failure

    def failing(R):
        if next(times) == 2:
            raise np.linalg.LinAlgError("SVD did not converge")
        return true(R)

    monkeypatch.setattr(measures, "rotation_error", failing)
    rows = run(two, tmp_path).rows
    assert [r["status"] for r in rows] == ["found"] * 2 + ["refused"] * 2 + ["found"] * 2
    assert {r["note"] for r in rows[2:4]} == {"unexpected LinAlgError: SVD did not converge"}


def test_how_many_sections_can_be_independent_is_said(two, tmp_path):
    first, last = two.span
    done = run(two, tmp_path, repeats=4, seconds=(15.0, 20.0))
    assert 50 < last - first < 60
    assert done.apart == {15.0: 3, 20.0: 2}
    assert "independent, at most: 3 of 15 s, 2 of 20 s." in summary.markdown("pair", done)


def test_a_truth_that_does_not_tell_enough_is_refused(two, ring, tmp_path):
    def without(drive, rows, columns):
        known = drive.truth.determined.copy()
        known[rows, columns] = False
        return replace(drive, truth=replace(drive.truth, determined=known))

    choices, config = experiment.Choices(1, (20.0,)), FAST
    with pytest.raises(DataError, match="does not say how it is turned of ins against velo"):
        experiment.run("pair", [without(two, 1, slice(3, 6))], tmp_path, choices, config, Silent())
    with pytest.raises(DataError, match="does not say how late the clock is of cam1, cam2 against cam0"):
        experiment.run("timing", [without(ring, slice(None), 6)], tmp_path, choices, config, Silent())
    with pytest.raises(DataError, match="ring has cam0, cam1, cam2 where rough has velo, ins; drives of one"):
        experiment.run("pair", [two, replace(ring, name="ring")], tmp_path, choices, config, Silent())
    with pytest.raises(DataError, match=r"no recording lasts long enough: 500 s: longer than rough \(5"):
        experiment.run("pair", [two], tmp_path, experiment.Choices(1, (500.0,)), config, Silent())
    assert not list(tmp_path.iterdir())
