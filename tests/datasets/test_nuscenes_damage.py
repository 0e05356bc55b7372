"""Recordings in nuScenes' tables that can not be right: rows, tables, links and files, each refused by its place."""

import numpy as np
import pytest
from nuscenes_builders import tables, write

from calib_toolkit import DataError
from calib_toolkit_datasets.nuscenes.tables import read_rows


def change(table, row, key, value):
    def changed(made):
        made[table][row][key] = value

    return changed


@pytest.mark.parametrize(
    ("how", "said"),
    [
        (change("sample_data", 5, "timestamp", 1_673_069_018_503_470_000), "row 5: the stamp .* microseconds"),
        (change("sample_data", 5, "timestamp", -3), "'timestamp' must be microseconds, and is '-3'"),
        (change("sample_data", 5, "timestamp", "noon"), "row 5: 'timestamp' must be microseconds"),
        (change("sample_data", 5, "timestamp", True), "row 5: 'timestamp' must be microseconds"),
        (change("sample_data", 5, "sample_token", "gone"), "row 5: 'sample_token' is 'gone', which sample.json"),
        (change("sample_data", 0, "calibrated_sensor_token", "x"), "which calibrated_sensor.json does not have"),
        (change("sample_data", 5, "ego_pose_token", "x"), "row 5: ego_pose.json has no 'x'"),
        (change("sample_data", 5, "ego_pose_token", []), "row 5: 'ego_pose_token' must be a text"),
        (change("sample_data", 5, "filename", "../secret.bin"), "row 5: '../secret.bin' lies outside"),
        (change("sample_data", 5, "filename", "/etc/passwd"), "row 5: '/etc/passwd' lies outside"),
        (change("sample_data", 5, "filename", "a\ud800"), "'filename' must be a text, and is 'a.ud800'"),
        (change("calibrated_sensor", 0, "sensor_token", 7), "row 0: 'sensor_token' must be a text, and is '7'"),
        (change("calibrated_sensor", 0, "rotation", [1, 1, 0, 0]), "row 0: 'rotation' must be a quaternion w x y z"),
        (change("calibrated_sensor", 0, "translation", ["1", 2, 3]), "row 0: 'translation' must be 3 finite numbers"),
        (change("calibrated_sensor", 0, "translation", [1, 2]), "row 0: 'translation' must be 3 finite numbers"),
        (change("calibrated_sensor", 1, "camera_intrinsic", [[1, 2], [3]]), "'camera_intrinsic' must be 3x3 finite"),
        (change("calibrated_sensor", 1, "camera_intrinsic", np.eye(3)[::-1].tolist()), "is no camera matrix"),
        (change("sensor", 0, "channel", "../../x"), "the channel '../../x' is none of letters"),
        (change("sensor", 1, "channel", "LIDAR_TOP"), "LIDAR_TOP has a second pose in one scene"),
        (change("ego_pose", 3, "rotation", [0, 0, 0, 0]), "ego_pose.json, row 3: 'rotation' must be a quaternion"),
        (change("ego_pose", 3, "translation", [1e300, 0, 0]), "row 3: 'translation' must be a place on earth"),
        (change("ego_pose", 3, "timestamp", None), "ego_pose.json, row 3: 'timestamp' must be microseconds"),
        (change("scene", 0, "name", None), "scene.json, row 0: 'name' must be a text, and is 'None'"),
        (lambda made: made["scene"].clear(), "has 0 scenes"),
        (lambda made: made["sample_data"].clear(), "holds no reading"),
    ],
)
def test_a_row_that_can_not_be_right_is_refused_by_its_place(tmp_path, opened, how, said):
    write(tmp_path, tables(1.0))
    made = tables(1.0)
    how(made)
    with pytest.raises(DataError, match=said):
        opened(write(tmp_path, made, files=False))


@pytest.mark.parametrize("name", ["sample", "sample_data", "calibrated_sensor", "sensor"])
def test_a_missing_table_is_named(tmp_path, opened, name):
    root = write(tmp_path, tables(1.0), files=False)
    (root / f"v1.0-mini/{name}.json").unlink()
    with pytest.raises(DataError, match=f"/{name}.json can not be read"):
        opened(root)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "it is no list of rows"),
        ("{}", "it is no list of rows"),
        ('[{"token": "a"}', "ends before its list does"),
        ('[{"token": "a"} {"token": "b"}]', "stands where a comma belongs"),
        ('[{"token": "a"},]', "a row is missing"),
        ('[{"token": "a"}, 3]', "damaged after row 0 .a row is missing"),
        ('[{"token": "a"}] more', "goes on behind its list"),
        ('[{"token": NaN}]', "NaN is no number"),
        ('[{"token": "a', "Unterminated string"),
        ('[{"token": ' + "[" * 100_000, "damaged after row -1"),
    ],
)
def test_a_damaged_table_is_named_with_the_place(tmp_path, text, said):
    file = tmp_path / "sample.json"
    file.write_text(text)
    with pytest.raises(DataError, match=said) as e:
        list(read_rows(file))
    assert str(file) in str(e.value)


def test_links_that_lead_out_are_refused_and_links_to_the_whole_are_not(tmp_path, opened):
    root = write(tmp_path / "data", tables(1.0))
    (tmp_path / "link").symlink_to(root)
    assert len(opened(tmp_path / "link").streams) == 4
    file = next((root / "samples/LIDAR_TOP").iterdir())
    file.rename(tmp_path / "outside.bin")
    file.symlink_to(tmp_path / "outside.bin")
    with pytest.raises(DataError, match="lies outside"):
        opened(root)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "holds no points"),
        (b"\0" * 30, "its 30 bytes are not a whole number of points of 20 bytes"),
        (np.full(10, np.nan, "<f4").tobytes(), "2 points are not numbers, first 0"),
    ],
)
def test_a_damaged_sweep_is_named(tmp_path, opened, content, said):
    root = write(tmp_path, tables(1.0))
    file = next((root / "samples/LIDAR_TOP").iterdir())
    readings = opened(root).streams["LIDAR_TOP"].readings
    file.write_bytes(content)
    with pytest.raises(DataError, match=f"{file.name}: sensor LIDAR_TOP: .*{said}"):
        readings[0]
    file.unlink()
    with pytest.raises(DataError, match="can not be read"):
        readings[0]


def test_half_an_image_and_one_of_another_size_are_refused(tmp_path, opened):
    root = write(tmp_path, tables(1.0))
    readings = opened(root).streams["CAM_FRONT"].readings
    file, other = next((root / "samples/CAM_FRONT").iterdir()), sorted((root / "sweeps/CAM_FRONT").iterdir())[0]
    other.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(DataError, match="not a whole jpeg or png"):
        readings[1]
    import cv2

    cv2.imwrite(str(file), np.zeros((9, 9), np.uint8))
    with pytest.raises(DataError, match="is 9 x 9 pixels where 24 x 16 belong"):
        readings[0]


@pytest.mark.parametrize("count", [60, pytest.param(1000, marks=pytest.mark.long)])
def test_damage_is_refused_or_changes_nothing_else(tmp_path, opened, count):
    """Values, keys, rows and bytes of the tables, changed at random: a sentence, or what is left is as it was."""
    whole = opened(write(tmp_path, tables(0.5)))
    rng, refused = np.random.default_rng(count), 0
    for _ in range(count):
        made = tables(0.5)
        touched = damaged(made, rng)
        write(tmp_path, made, files=False)
        if rng.random() < 0.2:
            cut_short(tmp_path, rng)
            touched = None
        try:
            log = opened(tmp_path)
        except DataError:
            refused += 1
            continue
        assert_the_rest_is_as_it_was(log, whole, touched)
    assert count // 4 < refused < count


ODD = (None, True, -1, 0, 3.5, 1e300, 10**30, "", "x", "../x", [], [1], {}, [[1]], float("nan"), "\ud800", "a\0b")


def damaged(made, rng):
    """Change one value, key or row; which table it was in."""
    table = rng.choice(list(made))
    row = made[table][rng.integers(len(made[table]))]
    key = rng.choice(list(row))
    kind = rng.integers(4)
    if kind == 0:
        del row[key]
    elif kind == 1:
        made[table].remove(row)
    elif kind == 2:
        made[table].append(dict(row))
    else:
        row[key] = ODD[rng.integers(len(ODD))]
    return table


def cut_short(root, rng):
    file = sorted((root / "v1.0-mini").iterdir())[rng.integers(7)]
    raw = bytearray(file.read_bytes())
    at = int(rng.integers(len(raw)))
    file.write_bytes(bytes(raw[:at]) if rng.random() < 0.5 else bytes([*raw[:at], rng.integers(256), *raw[at + 1 :]]))


def assert_the_rest_is_as_it_was(log, whole, touched):
    for name, stream in log.streams.items():
        if name not in whole.streams:
            continue  # another name is as good as the one before
        known = {round((log.epoch_ns - whole.epoch_ns) / 1e9 + t, 6): k for k, t in enumerate(stream.stamps)}
        theirs = {round(float(t), 6): k for k, t in enumerate(whole.streams[name].stamps)}
        common = known.keys() & theirs.keys()
        changed = len(known.keys() - theirs.keys())
        if touched is not None and name != "ego":
            assert changed <= 1, (name, touched)
        for t in list(common)[:3]:
            a, b = stream.readings[known[t]], whole.streams[name].readings[theirs[t]]
            np.testing.assert_array_equal(getattr(a, "points", 0), getattr(b, "points", 0))
