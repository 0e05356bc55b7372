"""Work is done once: cached by content, resumed after a kill, and the same whatever the number of processes."""

import json
from collections import Counter

import numpy as np
import pytest
from click.testing import CliRunner
from small_runs import killed_when

from calib_toolkit import cli, se3
from calib_toolkit_datasets import simulated

N, CHUNK = 201, 20
SLICES = -(-(N - 1) // CHUNK)
PLUGIN = '''
"""Motions in text files, one a reading; each estimate writes down what it was asked."""
import time
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from calib_toolkit import DataError, Dataset, LazyReadings, Log, Motions, Sensor, Stream, hookimpl

@dataclass(frozen=True)
class SlowOptions:
    gain: float = 1.0

def load(file):
    try:
        return np.array([float(word) for word in file.read_text().split()]).reshape(7)
    except (OSError, ValueError) as e:
        raise DataError(f"{file}: sensor slow, frame {int(file.stem)}, can not be read; copy it again") from e

def estimate(stream, options):
    time.sleep(0.2 * Path(COUNTER).with_suffix(".slowly").exists())
    rows = np.array([stream.readings[i] for i in range(len(stream))])
    with Path(COUNTER).open("a") as f:
        f.write(f"{stream.name} {stream.stamps[0]:.3f}\\n")
    vec = np.array([r[1:] for r in rows[1:]])
    whole = np.isclose(np.diff(stream.stamps), 0.1)  # a file left out leaves a gap behind it
    cov = np.tile(np.diag([1e-4] * 3 + [1e-7] * 3) * options.gain, (len(vec), 1, 1))
    return Motions(stream.stamps[:-1][whole], stream.stamps[1:][whole], vec[whole], cov[whole])

def open_log(path, context):
    streams = {}
    for name in ("a", "b"):
        files = sorted((path / name).iterdir())
        stamps = np.array([int(f.stem) for f in files]) / 10
        streams[name] = Stream(name, "slow", stamps, LazyReadings(load, files))
    return Log(path, streams)

@hookimpl
def calib_register_sensors():
    return [Sensor("slow", estimate, SlowOptions, version="VERSION", chunk=CHUNK)]

@hookimpl
def calib_register_datasets():
    return [Dataset("slow", "folders a and b", lambda path: (path / "a").is_dir(), open_log)]
'''


class Case:
    """A drive of two slow sensors, the plugin that reads it, and how often it was asked."""

    def __init__(self, folder):
        self.folder, self.drive, self.counter = folder, folder / "drive", folder / "counter.txt"
        self.cache = folder / "cache"
        self.plugin()
        true = simulated.path(N / 10, 3, "rough")
        poses = true.at(np.arange(N) / 10)
        for name, T_vehicle_sensor in (("a", np.eye(4)), ("b", se3.matrix([0.5, -0.3, 0.2, 0.1, -0.2, 0.3]))):
            (self.drive / name).mkdir(parents=True)
            T = poses @ T_vehicle_sensor
            vec = se3.vector(se3.relative(T[:-1], T[1:]))
            vec += np.random.default_rng([3, ord(name)]).normal(size=vec.shape) * [*[0.01] * 3, *[3e-4] * 3]
            for k, row in enumerate(np.vstack([np.zeros(6), vec])):
                text = " ".join(f"{x:.9f}" for x in (k, *row))
                (self.drive / name / f"{k:06d}.txt").write_text(text)

    def plugin(self, version="1"):
        """(Re)write the plugin file."""
        text = PLUGIN.replace("COUNTER", repr(str(self.counter)))
        (self.folder / "slow.py").write_text(text.replace("VERSION", version).replace("CHUNK", str(CHUNK)))

    def arguments(self, out="out", jobs=1, *more):
        """Those of the command; the paper's method, which is the quicker one."""
        chosen = ("-o", self.folder / out, "--jobs", jobs, "--plugin", self.folder / "slow.py", "--method", "paper")
        return [str(a) for a in ("run", self.drive, *chosen, *more)]

    def run(self, out="out", jobs=1, *more, status=0):
        """The result, as bytes; or the sentence of a refusal."""
        result = CliRunner().invoke(cli.main, self.arguments(out, jobs, *more))
        assert result.exit_code == status, result.output
        if status == 1:
            return result.stderr.splitlines()[-1]
        return (self.folder / out / "calibration.json").read_bytes()

    def asked(self):
        """How often each slice was estimated since the last time this was asked."""
        lines = self.counter.read_text().splitlines() if self.counter.exists() else []
        self.counter.unlink(missing_ok=True)
        return Counter(lines)

    def stored(self):
        """Files of finished slices."""
        return sorted(self.cache.rglob("*.npz"))


@pytest.fixture
def case(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIB_TOOLKIT_CACHE", str(tmp_path / "cache"))
    return Case(tmp_path)


def every(*names):
    return Counter(f"{name} {i * CHUNK / 10:.3f}" for name in names for i in range(SLICES))


def test_a_second_run_estimates_nothing_and_says_the_same(case):
    first = case.run()
    assert case.asked() == every("a", "b")
    assert case.run() == first
    assert case.asked() == Counter()


def test_the_result_does_not_depend_on_the_slices_being_stored(case, monkeypatch):
    stored = case.run()
    monkeypatch.setenv("CALIB_TOOLKIT_CACHE", str(case.folder / "other"))
    assert case.run() == stored
    assert case.asked() == every("a", "b") + every("a", "b")


def test_a_kill_half_way_costs_the_slice_at_hand(case):
    slowly = case.counter.with_suffix(".slowly")
    slowly.touch()
    killed_when(lambda: len(case.stored()) >= 5, *case.arguments())
    kept = len(case.stored())
    assert 5 <= kept < 2 * SLICES
    assert not (case.folder / "out/calibration.json").exists()
    asked = case.asked()
    slowly.unlink()
    case.run()
    again = case.asked()
    assert again.total() == 2 * SLICES - kept
    assert set(asked) | set(again) == set(every("a", "b"))
    assert len(set(asked) & set(again)) <= 1  # asked for, but not yet stored when the kill came


@pytest.mark.parametrize(
    ("k", "redone"), [(30, ["a 2.000"]), (40, ["a 2.000", "a 4.000"])], ids=["inside", "where two slices meet"]
)
def test_a_changed_file_is_estimated_anew(case, k, redone):
    first = case.run()
    case.asked()
    file = case.drive / f"a/{k:06d}.txt"
    words = file.read_text().split()
    file.write_text(" ".join([*words[:3], f"{float(words[3]) + 0.1:.9f}", *words[4:]]))
    assert case.run() != first
    assert case.asked() == Counter(redone)


def test_a_file_that_was_only_copied_elsewhere_counts_as_the_same(case):
    first = case.run()
    case.asked()
    case.drive = case.drive.rename(case.folder / "moved")
    assert case.run() == first
    assert case.asked() == Counter()


def test_a_changed_option_makes_that_sensor_anew(case):
    case.run()
    case.asked()
    (case.folder / "options.toml").write_text("[sensors.a]\ngain = 4.0\n")
    found = json.loads(case.run("out", 1, "--config", case.folder / "options.toml"))
    assert found["configuration"]["sensors"] == {"a": {"gain": 4.0}}
    assert case.asked() == every("a")


def test_options_of_a_kind_are_those_of_all_its_sensors(case):
    case.run()
    case.asked()
    (case.folder / "options.toml").write_text("[sensors.slow]\ngain = 4.0\n[sensors.b]\ngain = 1.0\n")
    case.run("out", 1, "--config", case.folder / "options.toml")
    assert case.asked() == every("a")


def test_another_version_of_the_plugin_makes_everything_anew(case):
    case.run()
    case.asked()
    case.plugin(version="2")
    case.run()
    assert case.asked() == every("a", "b")


@pytest.mark.parametrize(
    "damage",
    [
        lambda b: b"",
        pytest.param(lambda b: b"junk", marks=pytest.mark.long),
        pytest.param(lambda b: b[:100], marks=pytest.mark.long),
        pytest.param(lambda b: b[: len(b) // 2], marks=pytest.mark.long),
        lambda b: b[:-30],
        lambda b: b[:600] + bytes(x ^ 255 for x in b[600:700]) + b[700:],
        lambda b: b"PK\x03\x04" + bytes(200),
    ],
    ids=["empty", "junk", "head", "half", "without its end", "flipped", "hollow"],
)
def test_a_damaged_slice_is_estimated_anew(case, damage):
    first = case.run()
    case.asked()
    file = case.stored()[7]
    file.write_bytes(damage(file.read_bytes()))
    assert case.run() == first
    assert case.asked().total() == 1
    assert case.run() == first
    assert case.asked() == Counter()


def test_two_processes_say_what_one_says(case, monkeypatch):
    alone = json.loads(case.run())
    monkeypatch.setenv("CALIB_TOOLKIT_CACHE", str(case.folder / "other"))
    together = json.loads(case.run("out2", 2))
    assert case.asked() == every("a", "b") + every("a", "b")
    assert (alone["configuration"].pop("jobs"), together["configuration"].pop("jobs")) == (1, 2)
    assert alone == together


def test_what_can_not_be_read_is_left_out_and_said(case):
    for k in (33, 100):
        (case.drive / f"a/{k:06d}.txt").write_text("1 2 x")
    found = json.loads(case.run(status=3))
    unreadable = [w for w in found["warnings"] if "can not be read" in w]
    assert [f"a/{k:06d}.txt" in w for k, w in zip((33, 100), unreadable, strict=True)] == [True, True]
    assert found["statistics"]["readings"] == {"a": N - 1 - 4, "b": N - 1}
    assert json.loads(case.run(status=3)) == found  # the warnings are kept with the slices


def test_a_mended_file_is_used(case):
    file = case.drive / "a/000033.txt"
    content = file.read_text()
    file.write_text("")
    case.run(status=3)
    file.write_text(content)
    assert json.loads(case.run())["warnings"] == []


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.long)])
def test_more_than_a_tenth_unreadable_is_refused(case, jobs):
    for k in range(0, N, 9):
        (case.drive / f"b/{k:06d}.txt").write_text("")
    sentence = case.run("out", jobs, status=1)
    assert "sensor b: 23 of 201 readings can not be read" in sentence
    assert "b/000000.txt" in sentence
    assert not (case.folder / "out/calibration.json").exists()


def test_a_whole_slice_unreadable_is_a_gap(case):
    for k in range(CHUNK, 2 * CHUNK - 1):
        (case.drive / f"a/{k:06d}.txt").write_text("")
    found = json.loads(case.run(status=3))
    assert len([w for w in found["warnings"] if "can not be read" in w]) == CHUNK - 1
    assert found["statistics"]["common_steps"] < N - CHUNK
