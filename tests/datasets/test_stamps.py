"""Stamps of numbered files: matched by number, and made up where there are none."""

from pathlib import Path

import numpy as np

from calib_toolkit import tables
from calib_toolkit_datasets import stamps


def numbered(*numbers: int) -> dict[int, Path]:
    return {k: Path(f"{k:010d}.bin") for k in numbers}


def test_files_and_stamps_meet_by_number() -> None:
    ns = np.array([10, 20, tables.BLANK, 40, 35, 50])
    matched = stamps.match("velo", numbered(0, 2, 3, 4, 5, 6), ns)
    assert matched.numbers.tolist() == [0, 3, 5]
    assert matched.ns.tolist() == [10, 40, 50]
    assert [f.stem[-1] for f in matched.files] == ["0", "3", "5"]
    missing, blank, late = matched.notes
    assert "1 file(s) missing, the first is number 1" in missing
    assert "2 reading(s) dropped because they have no stamp, the first is number 2" in blank
    assert "1 reading(s) dropped because their stamps repeat or go back, the first is number 4" in late


def test_made_up_stamps_follow_the_frame_number() -> None:
    matched = stamps.made_up("velo", numbered(3000, 3001, 3003), 100)
    assert matched.ns.tolist() == [300_000, 300_100, 300_300]
    assert "3002" in matched.notes[0]
    assert "no stamps" in matched.notes[1]
