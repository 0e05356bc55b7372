"""Simulated drives that are cut off, begun again or asked for twice: nothing is made twice, nothing half is whole."""

import json
import shutil

import pytest
from simulated_files import hashes, quick_reading, wish

from calib_toolkit import DataError
from calib_toolkit.progress import Silent
from calib_toolkit_datasets.simulation import writing
from calib_toolkit_datasets.simulation.writing import write


class Counted(Silent):
    """Keeps what was begun and what was done."""

    def __init__(self):
        self.begun, self.made = {}, {}

    def begin(self, task, total, done=0):
        self.begun[task], self.made[task] = (total, done), 0

    def advance(self, task, units):
        self.made[task] += units


def test_what_is_there_is_kept_and_what_is_missing_is_made_again(quick, monkeypatch, tmp_path):
    write(tmp_path, wish(), Silent(), 1)
    before = hashes(tmp_path)
    (drive,) = tmp_path.glob("*_extract")
    gone = [drive / "velodyne_points/data/0000000004.bin", drive / "image_02/data/0000000001.png"]
    gone += [drive / "oxts/data/0000000150.txt", tmp_path / "truth.json", tmp_path / "rig.toml"]
    for file in gone:
        file.unlink()
    gone[0].with_name("0000000004.bin.part").write_bytes(b"cut short")
    kept = drive / "image_02/data/0000000002.png"
    kept.write_bytes(b"left alone")
    progress = Counted()
    write(tmp_path, wish(), progress, 1)
    assert progress.made == {"velo": 1, "cam0": 0, "cam1": 0, "cam2": 1, "cam3": 0, "ins": 1}
    assert progress.begun["velo"] == (19, 18)
    assert kept.read_bytes() == b"left alone"
    after = hashes(tmp_path)
    assert {f for f in before | after if before.get(f) != after.get(f)} == {str(kept.relative_to(tmp_path))}


def test_a_drive_that_was_cut_off_is_no_recording_yet(quick, monkeypatch, tmp_path):
    def killed(wish, sensor, instant, k, layout):
        if k == 7:
            raise KeyboardInterrupt
        return quick_reading(wish, sensor, instant, k, layout)

    monkeypatch.setattr(writing, "_reading", killed)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, wish(), Silent(), 1)
    assert not (tmp_path / "rig.toml").exists()
    assert not (tmp_path / "truth.json").exists()
    monkeypatch.setattr(writing, "_reading", quick_reading)
    whole = tmp_path.with_name("whole")
    write(tmp_path, wish(), Silent(), 1)
    write(whole, wish(), Silent(), 1)
    assert hashes(tmp_path) == hashes(whole)


def test_another_drive_in_the_same_folder_is_refused_by_what_differs(quick, tmp_path):
    write(tmp_path, wish("shrimp"), Silent(), 1)
    before = hashes(tmp_path)
    with pytest.raises(DataError, match=r"begun with seed 3, and seed 4 is asked for"):
        write(tmp_path, wish("shrimp", seed=4), Silent(), 1)
    (tmp_path / "drive.json").write_text(
        json.dumps(json.loads((tmp_path / "drive.json").read_text()) | {"version": "0.0.1"})
    )
    with pytest.raises(DataError, match=r"version 0\.0\.1"):
        write(tmp_path, wish("shrimp"), Silent(), 1)
    del before["drive.json"]
    assert before.items() <= hashes(tmp_path).items()


def test_a_folder_with_something_else_in_it_is_refused(tmp_path):
    (tmp_path / "letters.txt").write_text("mine")
    with pytest.raises(DataError, match="holds files of something else"):
        write(tmp_path, wish(), Silent(), 1)
    assert [f.name for f in tmp_path.iterdir()] == ["letters.txt"]


@pytest.mark.parametrize("content", ["[1]", "not json", "3"])
def test_a_folder_whose_description_is_damaged_is_refused(tmp_path, content):
    (tmp_path / "drive.json").write_text(content)
    with pytest.raises(DataError, match=str(tmp_path)):
        write(tmp_path, wish(), Silent(), 1)


def test_a_full_disk_is_foreseen(monkeypatch, tmp_path):
    usage = shutil.disk_usage(tmp_path)._replace(free=50_000_000)
    monkeypatch.setattr(writing, "disk_usage", lambda folder: usage)
    with pytest.raises(DataError, match=r"takes about 0\.1 GB and .* has 0\.1 GB free"):
        write(tmp_path, wish(), Silent(), 1)


def test_readings_are_the_same_in_whatever_order_they_are_made(tmp_path):
    w, layout = wish("shrimp", seconds=1.0), writing._layout(wish("shrimp"))
    sensor = writing.build_rig(w).sensor("velo")
    at = sensor.instants(sensor.stamps(w.seconds, w.seed))
    made = {}
    for k in (3, 0, 3):
        made.setdefault(k, set()).add(writing._reading(w, sensor, float(at[k]), k, layout))
        if k == 0:
            writing._scene.cache_clear()
    assert [len(x) for x in made.values()] == [1, 1]
    assert made[0] != made[3]
    assert len(next(iter(made[0]))) > 16 * 50_000


@pytest.mark.long
def test_the_same_seed_gives_the_same_bytes_with_one_process_and_with_two(tmp_path):
    for jobs in (1, 2):
        write(tmp_path / str(jobs), wish("shrimp", seconds=1.0), Silent(), jobs)
    one, two = (hashes(tmp_path / str(jobs)) for jobs in (1, 2))
    assert one == two
    assert len(one) > 40
