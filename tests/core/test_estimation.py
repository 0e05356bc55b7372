"""Each sensor's own motion in slices: what the plugin is given, what becomes of its answers, what is left out."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from calib_toolkit import estimation
from calib_toolkit.errors import ConfigError, DataError
from calib_toolkit.estimation import estimate_motions
from calib_toolkit.hookspecs import NoOptions, Sensor
from calib_toolkit.progress import Silent
from calib_toolkit.types import LazyReadings, Motions, Stream, Trajectory


@dataclass(frozen=True)
class Options:
    gate: float = 0.2
    levels: tuple[float, ...] = (2.0, 1.0)


class Recorder:
    """A sensor plugin's ``estimate`` that remembers what it was asked. Readings are their own numbers."""

    def __init__(self, answer=None):
        self.answer, self.asked = answer or steps, []

    def __call__(self, stream, options):
        numbers = [stream.readings[i] for i in range(len(stream))]
        self.asked.append((numbers, options))
        return self.answer(stream, numbers)

    @property
    def slices(self):
        return [numbers for numbers, _ in self.asked]


class Told:
    """Progress as it was told."""

    def __init__(self):
        self.total, self.done = {}, {}

    def begin(self, task, total, done=0):
        self.total[task], self.done[task] = total, done

    def advance(self, task, units):
        self.done[task] += units


def steps(stream, numbers):
    """A motion along x by each reading's number."""
    n = len(numbers) - 1
    vec = np.zeros((n, 6))
    vec[:, 0] = numbers[1:]
    return Motions(stream.stamps[:-1], stream.stamps[1:], vec, np.tile(np.eye(6), (n, 1, 1)), stream.has_scale)


def poses(stream, numbers):
    T = np.tile(np.eye(4), (len(numbers), 1, 1))
    T[:, 0, 3] = numbers
    zeros = np.zeros((len(numbers), 6, 6))
    return Trajectory(stream.stamps, T, zeros + np.eye(6), zeros)


def load(bad, k):
    if k in bad:
        raise DataError(f"{k}.bin: sensor velo, frame {k}, is empty; fetch it again")
    return k


def stream(n, bad=(), lazy=True, name="velo", **kwargs):
    readings = LazyReadings(partial(load, frozenset(bad)), range(n)) if lazy else list(range(n))
    return Stream(name, "stub", np.arange(n) / 10, readings, **kwargs)


def sensor(estimate, options=Options, chunk=10):
    return Sensor("stub", estimate, options, chunk=chunk)


def moved(s, estimate, options=None, progress=None, **kwargs):
    return estimate_motions([(s, sensor(estimate))], options or {}, progress or Silent(), **kwargs)[s.name]


# ---- slices


@pytest.mark.parametrize(
    ("n", "expected"),
    [
        (2, [(0, 2)]),
        (10, [(0, 10)]),
        (11, [(0, 11)]),
        (12, [(0, 11), (10, 12)]),
        (21, [(0, 11), (10, 21)]),
        (25, [(0, 11), (10, 21), (20, 25)]),
    ],
)
def test_slices_share_one_reading_and_cover_every_step_once(n, expected):
    estimate = Recorder()
    found = moved(stream(n), estimate).motions
    assert estimate.slices == [list(range(*e)) for e in expected]
    np.testing.assert_array_equal(found.vec[:, 0], np.arange(1, n))
    np.testing.assert_allclose(found.end - found.start, 0.1)
    np.testing.assert_array_equal(found.start[1:], found.end[:-1])


def test_readings_in_memory_are_one_slice():
    estimate = Recorder()
    moved(stream(35, lazy=False), estimate)
    assert estimate.slices == [list(range(35))]


def test_a_trajectory_stays_one_and_has_every_pose_once():
    found = moved(stream(35), Recorder(poses)).motion
    assert isinstance(found, Trajectory)
    np.testing.assert_array_equal(found.T_world_sensor[:, 0, 3], np.arange(35))


def test_a_trajectory_of_which_a_part_is_motions_becomes_motions():
    def mixed(part, numbers):
        return (poses if numbers[0] == 0 else steps)(part, numbers)

    found = moved(stream(35), Recorder(mixed)).motion
    assert isinstance(found, Motions)
    assert len(found) == 34


def test_what_has_no_scale_is_said_by_the_plugin():
    assert not moved(stream(25, has_scale=False), Recorder()).motions.has_scale


def test_progress_counts_every_step():
    told = Told()
    pair = [(stream(25, name="a"), sensor(Recorder())), (stream(11, name="b", lazy=False), sensor(Recorder()))]
    estimate_motions(pair, {}, told)
    assert told.total == told.done == {"a": 24, "b": 10}


@pytest.mark.parametrize("n", [0, 1])
def test_a_stream_that_is_too_short_is_refused_by_name(n):
    with pytest.raises(DataError, match=f"sensor velo has {n} reading") as refusal:
        moved(stream(n), Recorder())
    assert "leave" in str(refusal.value)


# ---- options


def test_options_are_the_defaults_then_the_logs_then_the_kinds_then_the_sensors():
    estimate = Recorder()
    s = stream(5, options={"gate": 0.3, "levels": (9.0,), "of another plugin": 1})
    moved(s, estimate, {"stub": {"levels": [4.0, 2.0]}})
    assert estimate.asked[-1][1] == Options(0.3, (4.0, 2.0))
    moved(s, estimate, {"stub": {"gate": 0.5}, "velo": {"gate": 0.7}})
    assert estimate.asked[-1][1] == Options(0.7, (9.0,))


@pytest.mark.parametrize("table", ["velo", "stub"])
def test_an_option_that_is_not_there_is_told_those_that_are(table):
    with pytest.raises(ConfigError, match=rf"\[sensors.{table}\].* no option 'gaet'.*gate, levels"):
        moved(stream(5), Recorder(), {table: {"gaet": 1.0}})


def test_a_sensor_without_options_has_none():
    with pytest.raises(ConfigError, match="it has: none"):
        estimate_motions([(stream(5), sensor(Recorder(), NoOptions))], {"velo": {"gate": 1.0}}, Silent())


# ---- what can not be read


def test_readings_that_can_not_be_read_are_left_out_and_said_once():
    def whole(part, numbers):
        m = steps(part, numbers)
        return m[np.isclose(m.end - m.start, 0.1)]

    estimate = Recorder(whole)
    found = moved(stream(41, bad=[15, 30]), estimate)
    assert [15 in numbers or 30 in numbers for numbers in estimate.slices] == [False] * 4
    assert np.setdiff1d(np.arange(1, 41), found.motions.vec[:, 0]).tolist() == [15, 16, 30, 31]
    said = [n for n in found.notes if "can not be read" in n or "is empty" in n]
    assert [f"{k}.bin" in n for k, n in zip((15, 30), said, strict=True)] == [True, True]


def test_one_bad_reading_of_few_is_no_reason_to_refuse():
    assert len(moved(stream(5, bad=[0]), Recorder()).motions) == 3


def test_more_than_a_tenth_is_refused_with_the_first_of_them():
    with pytest.raises(DataError, match=r"sensor velo: 5 of 41 readings can not be read, the first: 3\.bin"):
        moved(stream(41, bad=[3, 4, 5, 6, 7]), Recorder())


def test_a_tenth_is_not_too_many():
    assert len(moved(stream(41, bad=[3, 4, 5, 6]), Recorder()).motions) == 36


def test_a_refusal_that_no_reading_explains_is_passed_on():
    def refuse(part, numbers):
        raise DataError("sensor velo: its intrinsics are missing; give calib_cam_to_cam.txt")

    with pytest.raises(DataError, match="intrinsics are missing"):
        moved(stream(25), Recorder(refuse))


def test_a_sensor_without_any_motion_is_refused_by_name():
    with pytest.raises(DataError, match="sensor velo: no motion could be estimated from its 25 readings"):
        moved(stream(25), Recorder(lambda part, numbers: steps(part, numbers)[:0]))


def test_steps_without_a_motion_are_said():
    found = moved(stream(25), Recorder(lambda part, numbers: steps(part, numbers)[1:]))
    assert len(found.motions) == 21
    (note,) = found.notes
    assert "velo" in note
    assert "3 of its 24 steps" in note


# ---- kept on disk


def test_slices_are_kept_and_found_again(tmp_path):
    first, second = Recorder(), Recorder()
    one = moved(stream(25), first, folder=tmp_path)
    two = moved(stream(25), second, folder=tmp_path)
    assert (len(first.asked), len(second.asked)) == (3, 0)
    np.testing.assert_array_equal(one.motions.vec, two.motions.vec)


def test_what_is_in_memory_is_not_kept(tmp_path):
    moved(stream(25, lazy=False), Recorder(), folder=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_is_not_kept(tmp_path):
    def refuse(part, numbers):
        raise DataError("sensor velo: its calibration is missing; add it")

    with pytest.raises(DataError):
        moved(stream(25), Recorder(refuse), folder=tmp_path)
    again = Recorder()
    moved(stream(25), again, folder=tmp_path)
    assert len(again.asked) == 3


def test_notes_come_back_with_what_was_kept(tmp_path):
    first = moved(stream(41, bad=[15]), Recorder(), folder=tmp_path).notes
    assert moved(stream(41, bad=[15]), Recorder(), folder=tmp_path).notes == first
    assert first


def test_a_longer_part_of_the_drive_uses_the_slices_it_shares(tmp_path):
    moved(stream(21), Recorder(), folder=tmp_path)
    longer = Recorder()
    moved(stream(41), longer, folder=tmp_path)
    assert longer.slices == [list(range(20, 31)), list(range(30, 41))]


def test_the_share_that_may_be_unreadable_is_a_tenth():
    assert estimation.UNREADABLE == 0.1
