"""The ladybug: heads with one clock, matched by file number, each of them a camera."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib_toolkit import SensorTable, Stream
from calib_toolkit.errors import DataError
from calib_toolkit_plugins import ladybug

K = [100.0, 0, 50, 0, 100, 40, 0, 0, 1]
(LADYBUG,) = ladybug.calib_register_sensors()


def heads(folder: Path, numbers: list[list[int]], **change: Any) -> SensorTable:
    """A rig table of heads with images of these numbers, whose grey value is their number."""
    tables = []
    for head, of_head in enumerate(numbers):
        (folder / f"cam{head}").mkdir()
        for n in of_head:
            cv2.imwrite(str(folder / f"cam{head}" / f"image{n:05d}.png"), np.full((80, 100), n, np.uint8))
        tables.append({"images": f"cam{head}", "camera_matrix": K})
    (folder / "times.txt").write_text("".join(f"{10 + k / 10}\n" for k in range(5)))
    return SensorTable("lb", folder, {"times": "times.txt", "heads": tables, **change})


def test_heads_are_streams_of_one_clock(tmp_path: Path) -> None:
    assert LADYBUG.open_table is not None
    log = LADYBUG.open_table(heads(tmp_path, [[3, 4, 5, 6, 7]] * 3))
    assert list(log.streams) == ["lb0", "lb1", "lb2"]
    for stream in log.streams.values():
        assert (stream.kind, stream.clock, stream.has_scale) == ("ladybug", "lb", False)
        np.testing.assert_allclose(stream.stamps, np.arange(5) / 10, atol=1e-9)
        assert stream.intrinsics is not None
        np.testing.assert_array_equal(stream.intrinsics.K.ravel(), K)
    assert log.epoch_ns == 10 * 10**9


def test_images_missing_in_one_head_shift_nothing(tmp_path: Path) -> None:
    log = ladybug.open_table(heads(tmp_path, [[3, 4, 5, 6, 7], [4, 6, 7]]))
    one = log.streams["lb1"]
    np.testing.assert_allclose(one.stamps, [0.1, 0.3, 0.4], atol=1e-9)
    assert [int(image[0, 0]) for image in one.readings] == [4, 6, 7]
    assert one.notes == ("lb1: 2 of 5 images are missing",)
    assert not log.streams["lb0"].notes


def test_images_missing_in_every_head_shift_nothing_either(tmp_path: Path) -> None:
    log = ladybug.open_table(heads(tmp_path, [[3, 4, 6, 7], [4, 6, 7]]))
    np.testing.assert_allclose(log.streams["lb0"].stamps, [0.0, 0.1, 0.3, 0.4], atol=1e-9)
    np.testing.assert_allclose(log.streams["lb1"].stamps + 10, [10.1, 10.3, 10.4], atol=1e-9)


def test_it_refuses_to_guess_which_stamp_is_whose(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="5 stamps for 3 images numbered 1 to 3"):
        ladybug.open_table(heads(tmp_path, [[1, 2, 3], [2, 3]]))


def test_each_head_has_its_own_mask(tmp_path: Path) -> None:
    table = heads(tmp_path, [[0, 1, 2, 3, 4]] * 2)
    cv2.imwrite(str(tmp_path / "mask.png"), np.ones((80, 100), np.uint8))
    table.values["heads"][1]["mask"] = "mask.png"
    streams = ladybug.open_table(table).streams
    masks = [s.intrinsics.mask if s.intrinsics else None for s in streams.values()]
    assert masks[0] is None
    assert masks[1] is not None
    assert masks[1].sum() == 8000


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"heads": []}, "sensor lb needs 'heads'"),
        ({"heads": "cam0"}, "sensor lb needs 'heads'"),
        ({"heads": [{"images": "cam0"}]}, "sensor lb0 has no camera_matrix"),
        ({"heads": [{"images": "cam0", "camera_matrix": K, "focus": 1}]}, "sensor lb0 has the key 'focus'"),
        ({"times": "no.txt"}, r"sensor lb: times = 'no.txt', but there is no file .*no\.txt"),
        ({"clock": "gps"}, "sensor lb has the key 'clock'"),
    ],
)
def test_a_table_that_is_wrong_is_refused_by_name(tmp_path: Path, change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(DataError, match=sentence):
        ladybug.open_table(heads(tmp_path, [[0, 1, 2, 3, 4]], **change))


def test_a_head_without_intrinsics_is_named() -> None:
    stream = Stream("lb3", "ladybug", np.arange(2.0), [np.zeros((80, 100), np.uint8)] * 2)
    with pytest.raises(DataError, match="lb3 has no intrinsics"):
        LADYBUG.estimate(stream, LADYBUG.options())
