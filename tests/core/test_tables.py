"""Tables in text: keys and paths, rows and their places, stamps to the nanosecond, and which of them are kept."""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib_toolkit import DataError, SensorTable, tables

DAY = 1_317_042_145_964_389_445
"""Nanoseconds of 2011-09-26 13:02:25.964389445."""


def table(folder: Path, **values: Any) -> SensorTable:
    return SensorTable("ins", folder, values)


def written(folder: Path, text: str) -> Path:
    (folder / "table.txt").write_text(text)
    return folder / "table.txt"


def rows(folder: Path, text: str, fewest: int = 1, most: int = 9) -> list[tables.Row]:
    return tables.read_rows(written(folder, text), fewest, most)


def test_a_misspelt_key_is_refused_with_those_there_are(tmp_path: Path) -> None:
    tables.refuse_unknown(table(tmp_path, kind="gps_ins", fixes="a.csv"), ["fixes", "rate"])
    with pytest.raises(DataError, match=r"sensor ins has the key 'fixe', .*; it may have fixes, rate"):
        tables.refuse_unknown(table(tmp_path, fixe="a.csv"), ["fixes", "rate"])


def test_paths_start_at_the_table_or_at_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(tmp_path, "1")
    assert tables.table_file(table(tmp_path, fixes="table.txt"), "fixes") == file
    assert tables.table_file(table(Path("elsewhere"), fixes=str(file)), "fixes") == file
    assert tables.table_folder(table(tmp_path.parent, scans=tmp_path.name), "scans") == tmp_path
    monkeypatch.setenv("HOME", str(tmp_path))
    assert tables.table_file(table(Path("elsewhere"), fixes="~/table.txt"), "fixes") == file


@pytest.mark.parametrize("value", [None, 3, ["table.txt"]])
def test_a_path_that_is_missing_or_no_path_is_asked_for(tmp_path: Path, value: Any) -> None:
    given = table(tmp_path) if value is None else table(tmp_path, fixes=value)
    with pytest.raises(DataError, match='sensor ins needs fixes = "FILE"'):
        tables.table_file(given, "fixes")


def test_a_path_that_is_too_long_is_not_there_and_is_not_repeated_at_length(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"there is no file .*\.\.\.") as refusal:
        tables.table_file(table(tmp_path, fixes="9" * 5000), "fixes")
    assert len(str(refusal.value)) < 1000


def test_a_file_is_no_folder_and_a_folder_no_file(tmp_path: Path) -> None:
    written(tmp_path, "1")
    with pytest.raises(DataError, match=r"sensor ins: scans = 'table.txt', but there is no folder .*table\.txt"):
        tables.table_folder(table(tmp_path, scans="table.txt"), "scans")
    with pytest.raises(DataError, match=r"sensor ins: fixes = '\.', but there is no file"):
        tables.table_file(table(tmp_path, fixes="."), "fixes")


def test_rows_know_their_lines_whatever_is_between_them(tmp_path: Path) -> None:
    found = rows(tmp_path, "\ufeff# titles\n1 2\t3 # the first\n\n4, 5,\n")
    assert [row.line for row in found] == [2, 4]
    assert [row.words for row in found] == [["1", "2", "3"], ["4", "5", ""]]
    assert found[1].place == f"{tmp_path / 'table.txt'}, line 4"
    assert np.array_equal(tables.to_numbers(found, 3), [[1, 2, 3], [4, 5, np.nan]], equal_nan=True)
    assert tables.to_numbers(found, 2).tolist() == [[1, 2], [4, 5]]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1 2\n1\n1 2\n", r"table\.txt, line 2: 1 columns where 2 to 3 belong"),
        ("1 2\n\n1 2 3 4\n", r"table\.txt, line 3: 4 columns where 2 to 3 belong"),
        ("# nothing\n", r"table\.txt holds no rows; name a file that does"),
        ("stamp speed\n", r"table\.txt holds no rows below its titles"),
    ],
)
def test_rows_that_are_not_as_wanted_are_refused(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(DataError, match=sentence):
        tables.read_rows(written(tmp_path, text), 2, 3, titles=True)


def test_a_last_row_with_fewer_columns_than_the_one_before_was_cut_short(tmp_path: Path) -> None:
    for text in ("1 2 3\n2 2 3\n3 2", "1 2 3\n2 2 3\n3 -\n", "1 2 3\n2 2 3\n3.0e", "1,2,3\n2,2,3\n3,2"):
        found = rows(tmp_path, text, 1, 3)
        assert [row.cut for row in found] == [False, False, True]
        assert found[2].words == ["", "", ""]
        keep, notes = tables.usable_rows(tables.to_nanoseconds(found), tables.to_numbers(found, 3), found)
        assert keep.tolist() == [0, 1]
        assert notes == (
            f"{tmp_path / 'table.txt'}, line 3 has fewer columns than the line before it, as if the file had been "
            "cut short; left out",
        )
        assert tables.whole_rows(found) == (found[:2], notes)
        assert tables.whole_rows(found[:2]) == (found[:2], ())


def test_a_file_whose_only_row_was_cut_short_is_refused(tmp_path: Path) -> None:
    found = tables.read_rows(written(tmp_path, "stamp x y\n1 2"), 3, 3)[1:]
    with pytest.raises(
        DataError, match=r"line 2 has fewer columns .*, and nothing else is there; write the file anew"
    ):
        tables.whole_rows(found)


def test_a_file_that_ends_within_a_line_is_unfinished(tmp_path: Path) -> None:
    assert tables.unfinished(written(tmp_path, "1 2\n3 4\n")) == ()
    said = f"{tmp_path / 'table.txt'} ends in the middle of a line, as if cut short; its last number may be wrong"
    assert tables.unfinished(written(tmp_path, "1 2\n3 4")) == (said,)


def test_what_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe")
    for file in (tmp_path / "image.png", tmp_path, tmp_path / "nowhere"):
        with pytest.raises(DataError, match=f"{file} can not be read as text"):
            tables.read_rows(file, 1, 2)
        with pytest.raises(DataError, match=f"{file} can not be read as text"):
            tables.read_stamps(file)


def test_words_are_no_numbers(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"line 2: could not convert string to float: 'north'"):
        tables.to_numbers(rows(tmp_path, "1 2\n3 north\n"), 2)


def test_every_nanosecond_of_a_stamp_is_kept(tmp_path: Path) -> None:
    text = "1317042145.964389445\n1.317042145964389446e9\n2011-09-26T13:02:25.964389447\n-0.000000001\nnan\n,1\n"
    ns = tables.to_nanoseconds(rows(tmp_path, text))
    assert ns.tolist() == [DAY, DAY + 1, DAY + 2, -1, tables.BLANK, tables.BLANK]
    assert tables.to_nanoseconds(rows(tmp_path, f"{DAY}"), unit="1e-9").tolist() == [DAY]
    assert tables.seconds(ns[:3], DAY - 10**9).tolist() == [1.0, 1.000000001, 1.000000002]


def test_a_file_of_stamps_keeps_the_place_of_every_line(tmp_path: Path) -> None:
    ns = tables.read_stamps(
        written(tmp_path, "2011-09-26 13:02:25.964389445\n\n1317042146\n2011-09-26 13:02:26.5\n\n")
    )
    assert ns.tolist() == [DAY, tables.BLANK, 1_317_042_146 * 10**9, 1_317_042_146_500_000_000]


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("nonsense", "line 3: 'nonsense' is not a stamp; write seconds or YYYY-MM-DD"),
        ("13:02:25.5", "line 3: .* is not a stamp"),
        ("2011-09-26 13:02:25.96 x", "line 3: .* is not a stamp"),
        ("2011-13-26 13:02:25.5", "line 3: .* is not a stamp"),
        ("2011-09-26", "line 3: .* is not a stamp"),
        ("1e999999999999", "line 3: .* is (not a stamp|beyond any clock)"),
        ("1317042145964", "line 3: the stamp 1317042145964 is beyond any clock; convert it"),
        ("9999-01-01 00:00:00", "line 3: the stamp 9999-01-01 00:00:00 is beyond any clock"),
    ],
)
def test_what_is_no_stamp_is_refused(tmp_path: Path, line: str, sentence: str) -> None:
    with pytest.raises(DataError, match=rf"table\.txt, {sentence}"):
        tables.read_stamps(written(tmp_path, f"2011-09-26 13:02:25.9\n\n{line}\n"))


def test_usable_rows_are_whole_and_in_order_and_the_rest_is_noted(tmp_path: Path) -> None:
    found = rows(tmp_path, "# stamp x\n1 0\n2 nan\n3 0\n9 0\n4 0\nnan 0\n4 0\n5 0\n6 0\n")
    ns, numbers = tables.to_nanoseconds(found), tables.to_numbers(found, 2)
    keep, (hollow, late) = tables.usable_rows(ns, numbers, found)
    assert (ns[keep] / 1e9).tolist() == [1, 3, 4, 5, 6]
    assert "table.txt: 2 of 9 rows hold nan or nothing, the first in line 3; left out" in hollow
    assert "table.txt: 2 of 9 rows have a stamp that goes back or repeats, the first in line 5; left out" in late
    whole = [0, 2, 4]
    assert tables.usable_rows(ns[whole], numbers[whole], [found[k] for k in whole])[1] == ()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1 0\n", "has one row; a motion takes two"),
        ("1 0\n1 0\n1 0\n", "2 of 3 rows have a stamp that goes back or repeats"),
        ("1 nan\n2 nan\n3 0\n4 nan\n5 0\n4 0\n", "3 of 6 rows hold nan .* and .* 1 of 6 rows have a stamp that goes"),
    ],
)
def test_too_few_usable_rows_are_refused(tmp_path: Path, text: str, sentence: str) -> None:
    found = rows(tmp_path, text)
    with pytest.raises(DataError, match=sentence):
        tables.usable_rows(tables.to_nanoseconds(found), tables.to_numbers(found, 2), found)


def test_the_fewest_readings_are_dropped() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        ns = rng.integers(0, 8, rng.integers(1, 8))
        kept = ns[tables.increasing(ns)]
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
        ([], []),
        ([0, 10, 20, 15, 30], [True, True, True, False, True]),  # the one that goes back
        ([0, 10, 10, 20], [True, True, False, True]),  # the second of two alike
        ([0, 10, 9999, 20, 30], [True, True, False, True, True]),  # the one that leaps ahead, not all after it
    ],
)
def test_which_reading_goes(ns: list[int], kept: list[bool]) -> None:
    assert tables.increasing(np.array(ns)).tolist() == kept
