"""Rows of poses that are left out, and tables that are refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from odometry_files import SIGMA, opened, poses, written

from calib_toolkit import DataError
from calib_toolkit_plugins.odometry import OdometryOptions, estimate


def test_rows_with_nan_or_a_stamp_that_goes_back_or_repeats_are_left_out_with_a_note(tmp_path: Path) -> None:
    table = written(tmp_path, "tum", list(poses(30)))
    lines = (tmp_path / "poses.txt").read_text().splitlines()
    lines[5] = lines[5].replace(lines[5].split()[3], "nan")
    lines[10] = lines[9]
    lines[20], lines[21] = lines[21], lines[20]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    stream = opened(tmp_path, table)
    assert len(stream) == 27
    nan, late = stream.notes
    assert "1 of 30 rows hold nan or nothing, the first in line 6; left out" in nan
    assert "2 of 30 rows have a stamp that goes back or repeats, the first in line 11; left out" in late


@pytest.mark.parametrize("style", ["tum", "euroc", "kitti"])
def test_a_last_row_that_was_cut_short_is_left_out_with_a_note(tmp_path: Path, style: str) -> None:
    table = written(tmp_path, style, list(poses(30)))
    text = (tmp_path / "poses.txt").read_text()
    (tmp_path / "poses.txt").write_text(text[: -len(text.splitlines()[-1]) // 2])
    stream = opened(tmp_path, table)
    assert len(stream) == 29
    (note,) = stream.notes
    assert "poses.txt, line 32 has fewer columns than the line before it" in note


def test_a_table_of_another_program_may_end_without_an_end_of_line(tmp_path: Path) -> None:
    table = written(tmp_path, "tum", list(poses(30)))
    (tmp_path / "poses.txt").write_text((tmp_path / "poses.txt").read_text().rstrip())
    assert opened(tmp_path, table).notes == ()


@pytest.mark.parametrize("titles", ["stamp,x,y,z,qx,qy,qz,qw", "stamp,x,y,z,rx,ry,rz"])
def test_a_table_with_titles_says_where_it_was_cut(tmp_path: Path, titles: str) -> None:
    values = ",1,0,0,0,0,0,1" if "qw" in titles else ",1,0,0,0,0,1.25e-05"
    whole = "\n".join([titles, *(f"{k}{values}" for k in range(5))]) + "\n"
    table = {"poses": "poses.csv", "format": "csv"}
    (tmp_path / "poses.csv").write_text(whole)
    assert opened(tmp_path, table).notes == ()
    (tmp_path / "poses.csv").write_text(whole[:-1])
    assert len(opened(tmp_path, table)) == 5
    assert "poses.csv ends in the middle of a line, as if cut short" in opened(tmp_path, table).notes[0]
    (tmp_path / "poses.csv").write_text(whole[:-10])
    stream = opened(tmp_path, table)
    assert len(stream) == 4
    (note,) = stream.notes
    assert "poses.csv, line 6 has fewer columns than the line before it" in note


def test_motions_without_covariances_have_the_stated_sigma(tmp_path: Path) -> None:
    rows = [f"{k},1,0,0,0,0,1.25e-05" for k in range(12)]
    (tmp_path / "motions.csv").write_text("\n".join(["stamp,x,y,z,rx,ry,rz", *rows]) + "\n")
    stated = [0.1, 0.2, 0.3, 0.01, 0.02, 0.03]
    stream = opened(tmp_path, {"poses": "motions.csv", "format": "csv", "motion_sigma": stated})
    motions = estimate(stream, OdometryOptions(**stream.options))
    assert np.allclose(motions.cov, np.diag(np.square(stated)))


def test_one_stamp_that_leaps_ahead_costs_only_itself(tmp_path: Path) -> None:
    table = written(tmp_path, "tum", list(poses(30)))
    lines = (tmp_path / "poses.txt").read_text().splitlines()
    lines[8] = "2" + lines[8][1:]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    stream = opened(tmp_path, table)
    assert len(stream) == 29
    assert "1 of 30 rows have a stamp that goes back or repeats, the first in line 9" in stream.notes[0]


def test_quaternions_close_to_unit_are_normalised_and_others_refused(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    table = {"poses": "poses.txt", "format": "tum", "motion_sigma": SIGMA.tolist()}
    file.write_text("0 0 0 0 0 0 0 1.005\n1 1 0 0 0 0 0.09983341664 0.9950041653\n")
    assert opened(tmp_path, table).readings[0].T_world_sensor == pytest.approx(np.eye(4))
    file.write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1.02\n")
    with pytest.raises(DataError, match="line 2: the quaternion is not of length one; is format = 'tum' right"):
        opened(tmp_path, table)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"poses": None}, 'sensor slam needs poses = "FILE"'),
        ({"poses": "absent.txt"}, "there is no file .*absent.txt; correct the path"),
        ({"poses": "image.png"}, "can not be read as text"),
        ({"poses": "empty.txt"}, "holds no rows"),
        ({"format": "bag"}, "format = 'bag' is unknown; write one of tum, euroc, kitti"),
        ({"format": None}, "format = None is unknown"),
        ({"format": "kitti"}, "line 3: 8 columns where 12 belong"),
        ({"has_scale": "no"}, "has_scale must be true or false"),
        ({"motion_sigma": [0.1, 0.1]}, "motion_sigma must be six positive numbers"),
        ({"motion_sigma": [0.1, 0.1, 0.1, 0, 0, 0]}, "motion_sigma must be six positive numbers"),
        ({"motion_sigma": "small"}, "motion_sigma must be six positive numbers"),
        ({"sigmas": "short.txt"}, "short.txt has 1 rows and .*poses.txt 20; give one each"),
        ({"times": "short.txt"}, "times does not go with format = 'tum'; remove it"),
        ({"format": "csv", "sigmas": "short.txt"}, "sigmas does not go with format = 'csv'; remove it"),
        ({"poze": "x"}, "has the key 'poze', which is unknown here; it may have poses, format"),
        ({"poses": "cut.txt"}, "cut.txt, line 2: 5 columns where 8 belong"),
        ({"poses": "words.txt"}, "words.txt, line 1: 'now' is not a stamp"),
        ({"poses": "milliseconds.txt"}, "milliseconds.txt, line 1: the stamp 1317646534939 is beyond any clock"),
        ({"poses": "one.txt"}, "one.txt has one row"),
        ({"poses": "frozen.txt"}, "9 of 10 rows have a stamp that goes back or repeats"),
    ],
    ids=lambda v: " ".join(f"{k}={x}" for k, x in v.items()) if isinstance(v, dict) else "",
)
def test_a_table_that_can_not_be_used_is_refused(tmp_path: Path, change: dict[str, Any], sentence: str) -> None:
    table = written(tmp_path, "tum", list(poses(20)))
    row = " 0 0 0 0 0 0 1\n"
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe")
    (tmp_path / "empty.txt").write_text("# nothing\n")
    (tmp_path / "short.txt").write_text("1 1 1 1 1 1\n")
    (tmp_path / "cut.txt").write_text("1" + row + "2 0 0 0 0\n3" + row)
    (tmp_path / "words.txt").write_text("now" + row)
    (tmp_path / "milliseconds.txt").write_text("1317646534939" + row)
    (tmp_path / "one.txt").write_text("1" + row)
    (tmp_path / "frozen.txt").write_text(("1" + row) * 10)
    values = {k: v for k, v in (table | change).items() if v is not None}
    with pytest.raises(DataError, match=sentence):
        opened(tmp_path, values)


def test_a_kitti_file_that_holds_no_rotations_is_refused(tmp_path: Path) -> None:
    table = written(tmp_path, "kitti", [np.eye(4)] * 3)
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2 + "1 0 0 0 0 1 0 0 0 0 -1 0\n")
    with pytest.raises(DataError, match="line 3: the matrix is no rotation; is format = 'kitti' right"):
        opened(tmp_path, table)
