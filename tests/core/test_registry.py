"""The registry: who is found, who is refused and in which words; an example of every hook."""

import importlib
import importlib.metadata
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cloudpickle
import numpy as np
import pytest

from calib_toolkit import plugins
from calib_toolkit.errors import DataError, PluginError
from calib_toolkit.hookspecs import HookSpecs
from calib_toolkit.plugins import HOOKS, registry
from calib_toolkit.types import Calibration

ROOT = Path(__file__).parents[2]
Install = Callable[..., Path]

SENSOR = """
from calib_toolkit import NoOptions, Sensor, hookimpl

def estimate(stream, options):
    raise NotImplementedError

@hookimpl
def calib_register_sensors():
    return [Sensor("ID", estimate)]
"""

METRIC = """
import numpy as np
from calib_toolkit import CostMetric, hookimpl

class Nearness(CostMetric):
    id = "nearness"

    def accepts(self, kind_a, kind_b):
        return kind_a == "velodyne"

    def cost(self, T_a_b, pair):
        return float(np.linalg.norm(T_a_b - pair.prior.T_a_b))

@hookimpl
def calib_register_metrics():
    return [Nearness()]
"""

EXPORTER = """
import json
import numpy as np
from calib_toolkit import Calibration, Exporter, hookimpl

def write(calibration, path, intrinsics):
    path.write_text(json.dumps([calibration.base, list(calibration.names), calibration.T_base_sensor.tolist()]))

def read(path):
    base, names, T = json.loads(path.read_text())
    n = len(names)
    known = np.ones(n, dtype=bool)
    return Calibration(base, tuple(names), np.array(T), np.zeros(n), np.zeros((7 * n, 7 * n)), known,
                       np.ones((n, 7), dtype=bool))

@hookimpl
def calib_register_exporters():
    return [Exporter("poses-json", write, read)]
"""

DATASET = """
from calib_toolkit import Dataset, Log, hookimpl

def matches(path):
    return path.suffix == ".drive"

@hookimpl
def calib_register_datasets():
    return [Dataset("drive", "a file named *.drive", matches, lambda path, context: Log(path, {}))]
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """``install(name, code)`` makes the one-module distributions that are the only ones installed."""
    site = tmp_path / "site"
    site.mkdir()
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr(plugins, "distributions", lambda: importlib.metadata.distributions(path=[str(site)]))
    before = set(sys.modules)

    def install(name: str, code: str, version: str = "1.2") -> Path:
        module = name.replace("-", "_")
        (site / f"{module}.py").write_text(code)
        info = site / f"{module}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        (info / "entry_points.txt").write_text(f"[calib_toolkit]\n{module} = {module}\n")
        importlib.invalidate_caches()
        return site / f"{module}.py"

    yield install
    for module in set(sys.modules) - before:
        if str(getattr(sys.modules[module], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[module]


def one_file(tmp_path: Path, code: str, name: str = "mine.py") -> Path:
    (tmp_path / name).write_text(code)
    return tmp_path / name


def test_what_is_installed_is_found_with_its_distribution_version_and_source(install: Install) -> None:
    file = install("acme-radar", SENSOR.replace("ID", "radar"))
    (entry,) = registry().entries
    assert (entry.id, entry.kind) == ("radar", "sensor")
    assert (entry.distribution, entry.version, entry.source) == ("acme-radar", "1.2", str(file))
    assert registry().sensor("radar", "front").id == "radar"


def test_a_file_is_a_plugin_too(install: Install, tmp_path: Path) -> None:
    install("acme-radar", SENSOR.replace("ID", "radar"))
    found = registry([one_file(tmp_path, SENSOR.replace("ID", "sonar"))])
    assert set(found.sensors) == {"radar", "sonar"}
    assert [e.distribution for e in found.entries] == ["acme-radar", "(file)"]


def test_what_a_file_brings_can_be_sent_to_another_process(install: Install, tmp_path: Path) -> None:
    """As the workers of ``run --jobs`` need it: they have not loaded the file."""
    (sensor,) = registry([one_file(tmp_path, SENSOR)]).sensors.values()
    (tmp_path / "sent").write_bytes(cloudpickle.dumps(sensor.estimate))
    code = f"import pickle; print(pickle.load(open({str(tmp_path / 'sent')!r}, 'rb')).__name__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "estimate", done.stderr


def test_one_distribution_may_bring_several_kinds_under_one_id(install: Install) -> None:
    install("acme", SENSOR.replace("ID", "drive") + DATASET)
    assert {(e.kind, e.id) for e in registry().entries} == {("sensor", "drive"), ("dataset", "drive")}


@pytest.mark.parametrize(
    ("code", "sentence"),
    [
        ("import no_such_module", r"could not be loaded \(ModuleNotFoundError: No module named 'no_such_module'\)"),
        ("def broken(:", r"could not be loaded \(SyntaxError"),
        ("x = 1", "registers nothing; mark one of calib_register_sensors"),
        (SENSOR.replace("@hookimpl\n", ""), "registers nothing; mark one of calib_register_sensors"),
        (SENSOR.replace("register_sensors", "register_foo"), "calib_register_foo"),
        (
            SENSOR + "\ndef calib_register_foo():\n    return []\n",
            "implements a hook that does not exist, calib_register_foo; there are: calib_register_sensors",
        ),
        (SENSOR.replace("sensors()", "sensors(log)"), "does not fit the hooks: .*log"),
        (SENSOR.replace('[Sensor("ID", estimate)]', "1 / 0"), "calib_register_sensors failed .ZeroDivisionError"),
        (SENSOR.replace('[Sensor("ID", estimate)]', 'Sensor("ID", estimate)'), "must return a list, not Sensor"),
        (SENSOR.replace('[Sensor("ID", estimate)]', "None"), "must return a list, not NoneType"),
        (SENSOR.replace('"ID"', "7"), "must have an id that is a string"),
        (SENSOR.replace('[Sensor("ID", estimate)]', "[estimate]"), "must have an id that is a string"),
    ],
    ids=[
        *("missing import", "syntax", "no hook", "unmarked hook", "unknown hook", "unknown unmarked hook"),
        *("unknown argument", "raises", "no list", "nothing", "id no string", "no id"),
    ],
)
@pytest.mark.parametrize("way", ["installed", "file"])
def test_a_broken_plugin_is_refused_by_name_in_one_sentence(
    install: Install, tmp_path: Path, code: str, sentence: str, way: str
) -> None:
    files = [one_file(tmp_path, code, "acme_broken.py")] if way == "file" else []
    if way == "installed":
        install("acme-broken", code)
    with pytest.raises(PluginError, match=sentence) as refusal:
        registry(files)
    assert ("acme_broken.py" if way == "file" else "acme_broken of acme-broken") in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_name_that_is_too_long_is_refused() -> None:
    with pytest.raises(DataError, match=r"9\.\.\.9+ can not be looked up .*; correct the path"):
        registry().open_log(Path("9" * 5000))


def test_a_file_that_is_not_there_is_refused(install: Install, tmp_path: Path) -> None:
    with pytest.raises(PluginError, match=r"absent\.py: there is no such file"):
        registry([tmp_path / "absent.py"])


def test_two_plugins_that_claim_one_id_are_both_named(install: Install, tmp_path: Path) -> None:
    installed = install("acme-radar", SENSOR.replace("ID", "radar"))
    file = one_file(tmp_path, SENSOR.replace("ID", "radar"))
    with pytest.raises(PluginError, match="two plugins bring a sensor called 'radar'") as refusal:
        registry([file])
    for name in (str(installed), "acme-radar", str(file)):
        assert name in str(refusal.value)


def test_one_file_given_twice_is_refused(install: Install, tmp_path: Path) -> None:
    file = one_file(tmp_path, SENSOR)
    with pytest.raises(PluginError, match=r"mine\.py"):
        registry([file, file])


def test_a_kind_that_nothing_reads_is_refused_with_the_kinds_there_are(install: Install) -> None:
    install("acme-radar", SENSOR.replace("ID", "radar"))
    with pytest.raises(PluginError, match=r"sonar(.|\n)*radar") as refusal:
        registry().sensor("sonar", "front")
    assert "front" in str(refusal.value)


def test_hook_calib_register_sensors(install: Install, tmp_path: Path) -> None:
    found = registry([one_file(tmp_path, SENSOR.replace("ID", "radar"))])
    assert found.sensors["radar"].estimate.__name__ == "estimate"
    assert found.sensors["radar"].open_table is None


def test_hook_calib_register_metrics(install: Install, tmp_path: Path) -> None:
    """A small metric that only says how bad a pose is."""
    from calib_toolkit.types import Motions, Pair, Stream, Transform

    metric = registry([one_file(tmp_path, METRIC)]).metrics["nearness"]
    stream = Stream("velo", "velodyne", np.arange(2.0), [None, None])
    none = Motions(np.zeros(0), np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6, 6)))
    prior = Transform("velo", "cam0", np.eye(4), np.eye(6))
    pair = Pair(stream, stream, none, none, 0.0, np.array([[0, 0]]), prior)
    assert metric.accepts("velodyne", "monocular")
    assert not metric.accepts("monocular", "monocular")
    assert metric.overlap(pair)
    assert metric.cost(np.eye(4), pair) == 0.0
    assert metric.cost(2 * np.eye(4), pair) == 2.0


def test_hook_calib_register_exporters(install: Install, tmp_path: Path) -> None:
    """A small exporter, out and back in."""
    exporter = registry([one_file(tmp_path, EXPORTER)]).exporters["poses-json"]
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, 3] = [1.0, 2.0, 3.0]
    known = np.ones(2, dtype=bool)
    rig = Calibration(
        "velo", ("velo", "cam0"), T, np.zeros(2), np.zeros((14, 14)), known, np.ones((2, 7), dtype=bool)
    )
    exporter.write(rig, tmp_path / "rig.json", {})
    assert json.loads((tmp_path / "rig.json").read_text())[0] == "velo"
    assert np.array_equal(exporter.read(tmp_path / "rig.json").T_base_sensor, T)


def test_hook_calib_register_datasets(install: Install, tmp_path: Path) -> None:
    """A reader is found by what it recognises, by its id, and named when nothing is recognised."""
    found = registry([one_file(tmp_path, DATASET)])
    (tmp_path / "monday.drive").touch()
    (tmp_path / "monday.bag").touch()
    assert found.open_log(tmp_path / "monday.drive").source == tmp_path / "monday.drive"
    assert found.open_log(tmp_path / "monday.bag", "drive").source == tmp_path / "monday.bag"
    with pytest.raises(DataError, match=r"no reader knows .*monday\.bag: drive looks for a file named \*\.drive"):
        found.open_log(tmp_path / "monday.bag")
    with pytest.raises(DataError, match="no reader is called 'rosbag'; there are: drive"):
        found.open_log(tmp_path / "monday.bag", "rosbag")


def test_two_readers_that_know_one_path_are_named(install: Install, tmp_path: Path) -> None:
    files = [one_file(tmp_path, DATASET.replace('"drive", "a', f'"{x}", "a'), f"{x}.py") for x in ("one", "other")]
    (tmp_path / "monday.drive").touch()
    with pytest.raises(DataError, match="looks like one and like other; choose with --format"):
        registry(files).open_log(tmp_path / "monday.drive")


def test_built_ins_arrive_through_the_entry_points_of_their_distribution() -> None:
    found = registry()
    assert {"velodyne", "monocular", "ladybug", "gps_ins", "odometry"} <= set(found.sensors)
    assert {"kitti-raw", "kitti-360", "multi-array-calib", "rig"} <= set(found.datasets)
    built_in = [e for e in found.entries if e.distribution == "calib-toolkit"]
    assert all(Path(e.source).is_file() and e.version for e in built_in)


def test_every_hook_has_a_test_and_a_heading() -> None:
    specified = {name for name in vars(HookSpecs) if name.startswith("calib_register_")}
    assert specified == set(HOOKS)
    guide = (ROOT / "docs" / "write-a-plugin.md").read_text()
    for hook in specified:
        assert f"test_hook_{hook}" in globals(), f"{hook} has no test"
        assert re.search(rf"^#+ .*`{hook}`", guide, re.MULTILINE), f"{hook} has no heading in write-a-plugin"


def test_the_command_lists_plugins_and_where_they_come_from(tmp_path: Path) -> None:
    far = tmp_path / ("a_folder_with_a_long_name_" * 5)
    far.mkdir()
    file = one_file(far, SENSOR.replace("ID", "sonar"))
    command = [Path(sys.executable).with_name("calib-toolkit"), "plugins", "--plugin", file]
    environment = {"PATH": "/usr/bin:/bin", "LC_ALL": "C.UTF-8"}  # no terminal, so nothing is broken over lines
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    lines = [set(line.split()) for line in done.stdout.splitlines()]
    assert [{"sensor", "(file)", str(file)} <= words for words in lines if "sonar" in words] == [True]
    assert [{"sensor", "calib-toolkit"} <= words for words in lines if "odometry" in words] == [True]
