"""Stamps to the nanosecond, and which of them are kept."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from calib_toolkit.errors import DataError
from calib_toolkit_datasets import stamps


def test_every_nanosecond_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "timestamps.txt"
    file.write_text("2011-09-26 13:02:25.964389445\n\n2011-09-26 13:02:25.964389446\n2011-09-26 13:02:26\n")
    ns = stamps.read_stamps(file)
    assert ns[2] - ns[0] == 1
    assert ns[1] == stamps.BLANK
    assert ns[0] == 1_317_042_145_964_389_445
    assert ns[3] % 1_000_000_000 == 0


@pytest.mark.parametrize("line", ["13:02:25.5", "1317042145.96", "2011-09-26 13:02:25.96 x", "2011-13-26 13:02:25.5"])
def test_what_is_no_stamp_is_refused(tmp_path: Path, line: str) -> None:
    file = tmp_path / "timestamps.txt"
    file.write_text(f"2011-09-26 13:02:25.964389445\n{line}\n")
    with pytest.raises(DataError, match=r"timestamps\.txt"):
        stamps.read_stamps(file)


def test_the_bad_line_is_named(tmp_path: Path) -> None:
    file = tmp_path / "timestamps.txt"
    file.write_text("2011-09-26 13:02:25.9\n\nnonsense\n")
    with pytest.raises(DataError, match=r"line 3 .*nonsense"):
        stamps.read_stamps(file)


def test_the_fewest_readings_are_dropped() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        ns = rng.integers(0, 8, rng.integers(1, 8))
        kept = ns[stamps.increasing(ns)]
        assert np.all(np.diff(kept) > 0)
        best = max(
            size
            for size in range(1, len(ns) + 1)
            if any(np.all(np.diff(ns[list(c)]) > 0) for c in combinations(range(len(ns)), size))
        )
        assert len(kept) == best


@pytest.mark.parametrize(
    ("ns", "kept"),
    [
        ([0, 10, 20, 15, 30], [True, True, True, False, True]),  # the one that goes back
        ([0, 10, 10, 20], [True, True, False, True]),  # the second of two alike
        ([0, 10, 9999, 20, 30], [True, True, False, True, True]),  # the one that leaps ahead, not all after it
    ],
)
def test_which_reading_goes(ns: list[int], kept: list[bool]) -> None:
    assert stamps.increasing(np.array(ns)).tolist() == kept


def test_made_up_stamps_follow_the_frame_number() -> None:
    files = {k: Path(f"{k:010d}.bin") for k in (3000, 3001, 3003)}
    matched = stamps.made_up("velo", files, 100)
    assert matched.ns.tolist() == [300_000, 300_100, 300_300]
    assert "3002" in matched.notes[0]
    assert "no stamps" in matched.notes[1]
