"""Recordings put together: exact epochs, names, clocks, and every mistake in a rig.toml in one sentence."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kitti_raw_drives import DriveWriter

from calib_toolkit import DataError, Log, Motions, ReadContext, Sensor, SensorTable, Stream
from calib_toolkit_datasets import kitti_raw, rig

EPOCH_NS = 1_317_646_534_414_198_001


def not_run(stream: Stream, options: object) -> Motions:
    raise NotImplementedError


def open_ticks(table: SensorTable) -> Log:
    """A sensor of n readings a tenth of a second apart, whose file must lie beside the rig.toml."""
    assert (table.folder / table.values["file"]).is_file()
    names = [table.name + head for head in table.values.get("heads", [""])]
    times = 0.1 * np.arange(table.values["n"])
    streams = {n: Stream(n, "ticks", times, list(range(len(times))), clock=table.name) for n in names}
    return Log(table.folder, streams, table.values.get("epoch_ns", EPOCH_NS))


TICKS = Sensor("ticks", not_run, open_table=open_ticks)
SILENT = Sensor("silent", not_run)


def context(opens: Callable[[Path], Log] | None = None) -> ReadContext:
    def nothing(path: Path) -> Log:
        raise DataError(f"{path} does not exist; name the folder or file of a recording")

    return ReadContext({"ticks": TICKS, "silent": SILENT}, opens or nothing)


def write(folder: Path, text: str) -> Path:
    (folder / "ticks.bin").touch()
    (folder / "rig.toml").write_text(text)
    return folder


def test_folder_and_file_are_the_same_rig(tmp_path: Path) -> None:
    write(tmp_path, '[sensors.a]\nkind = "ticks"\nfile = "ticks.bin"\nn = 3\n')
    for path in (tmp_path, tmp_path / "rig.toml"):
        assert rig.matches(path)
        log = rig.open_log(path, context())
        assert list(log.streams) == ["a"]
        assert len(log.streams["a"]) == 3
    assert not rig.matches(tmp_path / "ticks.bin")
    assert not rig.matches(tmp_path / "nowhere")


@pytest.mark.parametrize("apart_ns", [1, 123_456_789, -1, 86_400_000_000_001])
def test_epochs_merge_to_the_nanosecond(tmp_path: Path, apart_ns: int) -> None:
    table = '[sensors.{}]\nkind = "ticks"\nfile = "ticks.bin"\nn = 3\nepoch_ns = {}\n'
    log = rig.open_log(
        write(tmp_path, table.format("a", EPOCH_NS) + table.format("b", EPOCH_NS + apart_ns)), context()
    )
    assert log.epoch_ns == min(EPOCH_NS, EPOCH_NS + apart_ns)
    apart = log.streams["b"].stamps[0] - log.streams["a"].stamps[0]
    assert abs(apart - apart_ns / 1e9) < 1e-10
    assert min(s.stamps[0] for s in log.streams.values()) == 0.0


def test_a_log_with_unix_seconds_and_no_epoch_joins(tmp_path: Path) -> None:
    def opens(path: Path) -> Log:
        stamps = EPOCH_NS / 1e9 + 0.1 * np.arange(3)
        return Log(path, {"pose": Stream("pose", "ticks", stamps, [1, 2, 3])})

    text = '[sensors.a]\nkind = "ticks"\nfile = "ticks.bin"\nn = 3\n[sensors.pose]\nlog = "other"\n'
    log = rig.open_log(write(tmp_path, text), context(opens))
    assert abs(log.streams["pose"].stamps[0] - log.streams["a"].stamps[0]) < 1e-6
    assert 0 <= min(s.stamps[0] for s in log.streams.values()) < 1e-6


def test_two_sensors_of_one_drive(write_drive: DriveWriter, tmp_path: Path) -> None:
    drive = write_drive()
    opens: list[Path] = []

    def open_drive(path: Path) -> Log:
        opens.append(path)
        return kitti_raw.open_log(path, context())

    text = f"""
    [sensors.lidar]
    log = "{drive.relative_to(tmp_path)}"
    sensor = "velo"
    [sensors.ins]
    log = "{drive}"
    """
    log = rig.open_log(write(tmp_path, text), context(open_drive))
    whole = kitti_raw.open_log(drive, context())
    assert opens == [drive]  # once for both
    assert list(log.streams) == ["lidar", "ins"]
    assert (log.streams["lidar"].name, log.streams["lidar"].clock, log.streams["lidar"].kind) == (
        "lidar",
        "lidar",
        "velodyne",
    )
    assert log.epoch_ns == whole.epoch_ns
    assert log.streams["lidar"].stamps == pytest.approx(whole.streams["velo"].stamps, abs=1e-12)
    assert log.streams["ins"].stamps == pytest.approx(whole.streams["ins"].stamps, abs=1e-12)
    assert log.streams["lidar"].readings[2].intensity[0] == 2


def test_shared_clocks_stay_shared_and_do_not_spread(tmp_path: Path) -> None:
    def opens(path: Path) -> Log:
        one = Stream("h0", "ticks", np.arange(3.0), [0, 1, 2], clock="rig")
        streams = {"h0": one, "h1": replace(one, name="h1"), "solo": replace(one, name="solo", clock="solo")}
        return Log(path, streams, EPOCH_NS)

    text = "".join(f'[sensors.{n}]\nlog = "{p}"\nsensor = "{s}"\n' for n, p, s in
                   (("a", "x", "h0"), ("b", "x", "h1"), ("c", "y", "h0"), ("d", "x", "solo")))  # fmt: skip
    clocks = {n: s.clock for n, s in rig.open_log(write(tmp_path, text), context(opens)).streams.items()}
    assert clocks["a"] == clocks["b"]
    assert len(set(clocks.values())) == 3
    assert clocks["d"] == "d"


def test_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    opens: list[Path] = []

    def note(path: Path) -> Log:
        opens.append(path)
        return Log(path, {"a": Stream("a", "ticks", np.arange(2.0), [0, 1])})

    rig.open_log(write(tmp_path, '[sensors.a]\nlog = "~/drive"\n'), context(note))
    assert opens == [tmp_path / "home/drive"]


A = '[sensors.a]\nkind = "ticks"\nfile = "ticks.bin"\nn = 3\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[sensors.a\n", "rig.toml can not be read"),
        (A + A, "rig.toml can not be read: Cannot declare"),
        ("", "holds none"),
        ("[other]\nx = 1\n", "remove 'other'"),
        ("sensors = 3\n", "holds none"),
        ("[sensors]\na = 3\n", r"write it as \[sensors.a\]"),
        ("[sensors.a]\nn = 3\n", "sensor a needs either 'kind'"),
        (A + 'log = "x"\n', "sensor a needs either 'kind'"),
        ('[sensors.a]\nkind = "sonar"\n', "sensor a is of kind 'sonar', which no installed plugin reads.*: ticks"),
        ("[sensors.a]\nkind = 3\n", "sensor a is of kind 3"),
        ('[sensors.a]\nkind = "silent"\n', "sensor a is of kind 'silent', which can not be read from a rig.toml"),
        ('[sensors.a]\nkind = "ticks"\nn = 3\n', "sensor a lacks the key 'file'"),
        ('[sensors.a]\nlog = "gone"\n', "sensor a: .*gone does not exist"),
        ('[sensors.a]\nlog = "."\n', "sensor a: .* is a rig itself"),
        ('[sensors.a]\nlog = "x"\nhas_scale = true\n', "sensor a has the key 'has_scale'"),
        ("[sensors.a]\nlog = 3\n", "sensor a: 'log' and 'sensor' must be strings"),
        (A + 'heads = ["0"]\n' + A.replace("sensors.a", "sensors.a0"), "two tables bring a sensor called 'a0'"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(DataError, match=rf"(?s).*rig\.toml.*{says}|{says}") as refusal:
        rig.open_log(write(tmp_path, text), context())
    assert "rig.toml" in str(refusal.value)


def test_a_sensor_that_the_log_lacks_is_named_with_those_it_has(write_drive: DriveWriter, tmp_path: Path) -> None:
    write(tmp_path, f'[sensors.a]\nlog = "{write_drive()}"\nsensor = "radar"\n')
    with pytest.raises(DataError, match=r"sensor a: .*no sensor named 'radar'; it has: velo, cam0"):
        rig.open_log(tmp_path, context(lambda path: kitti_raw.open_log(path, context())))
