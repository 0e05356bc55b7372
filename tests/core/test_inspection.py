"""What is wrong with a recording is found and said: each fault alone, and nothing on a sound drive."""

from pathlib import Path

import numpy as np
import pytest

from calib_toolkit.inspection import inspect_log
from calib_toolkit.types import Log, Stream

SOUND = np.arange(600) / 10


def log(notes=(), **streams):
    return Log(
        Path("drive"),
        {n: s if isinstance(s, Stream) else Stream(n, "odometry", s, range(len(s))) for n, s in streams.items()},
        notes=notes,
    )


def jittered(share, seed=0):
    return SOUND + np.random.default_rng(seed).uniform(-share / 20, share / 20, len(SOUND))


def test_a_sound_drive_is_clean():
    seen = inspect_log(log(velo=SOUND + 100, ins=np.arange(6000) / 100 + 100.05, cam0=jittered(0.2) + 100))
    assert seen.problems == ()
    assert seen.clean
    assert [s.name for s in seen.sensors] == ["velo", "ins", "cam0"]


def test_the_numbers_of_a_sensor():
    stamps = np.delete(SOUND, np.arange(200, 206)) + 50
    velo, ins = inspect_log(log(velo=stamps, ins=SOUND + 52.5)).sensors
    assert (velo.readings, velo.kind, velo.gaps) == (594, "odometry", 1)
    assert velo.rate == pytest.approx(10)
    assert (velo.start, velo.end) == pytest.approx((0.0, 59.9))
    assert (ins.start, ins.end) == pytest.approx((2.5, 62.4))
    assert (velo.largest_gap, velo.gap_at) == pytest.approx((0.7, 19.9))


@pytest.mark.parametrize(
    ("streams", "sentence"),
    [
        ({}, "drive holds no sensor at all"),
        ({"velo": SOUND, "ins": SOUND[:0]}, "ins has no readings where motion needs two"),
        ({"velo": SOUND, "ins": SOUND[:1]}, "ins has one reading where motion needs two"),
        ({"velo": SOUND[:50], "ins": SOUND[:50]}, "the drive lasts only 4.9 s"),
        ({"velo": SOUND, "ins": SOUND[:200]}, "ins covers only 19.9 s of the 59.9 s drive"),
        (
            {"velo": np.r_[SOUND[:100], SOUND[140:300], SOUND[304:]]},
            "velo has 2 gaps of over 3 periods; the longest is 4.100 s, 9.900 s into the drive",
        ),
        ({"velo": np.r_[SOUND[:100], SOUND[140:]]}, "velo has 1 gap of over 3 periods"),
        ({"velo": jittered(0.95)}, "velo is irregular: its readings come 0.0"),
    ],
)
def test_each_fault_is_the_only_problem(streams, sentence):
    (problem,) = inspect_log(log(**streams)).problems
    assert problem.startswith(sentence)


def test_sensors_that_share_no_time_are_named():
    problems = inspect_log(log(velo=SOUND, cam0=SOUND, ins=SOUND + 3600)).problems
    apart = [p for p in problems if "do not overlap" in p]
    assert [p.split(" do not")[0] for p in apart] == [
        "velo (0.0 to 59.9 s) and ins (3600.0 to 3659.9 s)",
        "cam0 (0.0 to 59.9 s) and ins (3600.0 to 3659.9 s)",
    ]


def test_notes_of_the_reader_come_first_and_name_their_sensor():
    cam0 = Stream("cam0", "monocular", SOUND, range(600), notes=("cam0: image 7 is missing", "2 images were black"))
    problems = inspect_log(log(cam0=cam0, notes=("the calibration file is missing",))).problems
    assert problems == ("the calibration file is missing", "cam0: image 7 is missing", "cam0: 2 images were black")


def test_no_reading_is_loaded():
    class Forbidden(list):
        def __getitem__(self, i):
            raise AssertionError("a reading was loaded")

    assert inspect_log(log(velo=Stream("velo", "velodyne", SOUND, Forbidden(range(600))))).clean
