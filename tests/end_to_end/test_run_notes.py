"""What the table of a run says beside its numbers: noise, rejected readings, how long to drive."""

from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from calib_toolkit import Calibration, Result
from calib_toolkit.cli.tables import show_result


def said(**statistics):
    """The notes below the table of a rig of two, as lines."""
    rig = Calibration(
        "velo", ("velo", "cam0"), np.tile(np.eye(4), (2, 1, 1)), np.zeros(2), np.eye(14), np.ones(2, bool),
        np.ones((2, 7), bool),
    )  # fmt: skip
    console = Console(file=StringIO(), width=100, highlight=False)
    show_result(Result(rig, {}, statistics=statistics), console)
    return [line.removeprefix("note: ") for line in console.file.getvalue().splitlines() if line.startswith("note")]


def scale(turns=1.0, shifts=1.0, kind="own", kind_of_shifts="own"):
    return {"turns": turns, "kind": kind, "shifts": shifts, "kind_of_shifts": kind_of_shifts}


def test_nothing_is_noted_where_all_is_well():
    assert said() == []
    assert said(
        noise_scale={"velo": scale(3.9, 0.26), "cam0": {"turns": 1.0, "kind": "own"}},
        rejected={"velo": 0.05, "cam0": 0.0},
        bias_deg={"velo": 0.0, "cam0": 0.2},
        driving={"cam0": {"x": 599.0, "rz": 600.0, "dt": 1e6}},
        seconds=600.0,
        prior=[],
    ) == []  # fmt: skip
    assert said(bias_deg=None) == []


def test_a_stated_noise_that_is_off_is_noted_with_what_it_was_told_for():
    assert said(noise_scale={"velo": scale(32.5, 0.04), "cam0": scale(9.0, 1.0)}) == [
        "turns are noisier than stated: velo 5.7 times, cam0 3.0 times (told for each alone)",
        "shifts are less noisy than stated: velo 5.0 times (told for each alone)",
    ]
    assert said(noise_scale={n: scale(1.0, 6.25, kind_of_shifts="pair") for n in ("velo", "cam0")}) == [
        "shifts are noisier than stated: velo 2.5 times, cam0 2.5 times (told for the pair, not for each)"
    ]


def test_rejected_readings_and_turned_travel_are_noted():
    assert said(rejected={"velo": 0.04, "cam0": 0.213}) == ["readings rejected because they do not fit: 21% of cam0"]
    (note,) = said(bias_deg={"velo": 0.0, "cam0": 0.51})
    assert note.startswith("travel is turned against turns: cam0 by 0.5 deg; a fault of that sensor's own motion")
    assert "velo's if all have it" in note
    assert said(prior=["cam0.z", "cam0.dt"]) == ["held by measured values: cam0.z, cam0.dt"]


@pytest.mark.parametrize(
    ("needs", "words"),
    [
        ({"x": 10, "z": 700, "rx": 5}, "12 min to know every position above to 2 cm (cam0 z needs most)"),
        ({"z": 5, "ry": 90000}, "25 h to know every angle above to 0.06 deg (cam0 about y needs most)"),
        (
            {"y": 90, "rz": 300},
            "90 s to know every position above to 2 cm (cam0 y needs most), and "
            "5 min to know every angle above to 0.06 deg (cam0 about z needs most)",
        ),
    ],
)
def test_how_long_to_drive_is_noted_where_it_is_longer_than_was_driven(needs, words):
    assert said(driving={"cam0": needs}, seconds=60.0) == [f"drive like this, in all, {words}"]
    assert said(driving={"cam0": needs}, seconds=60.0, pairs=[{"metric": "im"}]) == []
