"""The registry: what is installed, from where, and nothing twice."""

import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast
from zlib import crc32

import pluggy

from calib_toolkit.errors import DataError, PluginError
from calib_toolkit.hookspecs import CostMetric, Dataset, Exporter, HookSpecs, Metric, ReadContext, Sensor
from calib_toolkit.packed import refuse_packed
from calib_toolkit.types import Log

GROUP = "calib_toolkit"
FILE = "(file)"
"""What stands for the distribution of a plugin given as one file."""
HOOKS = {
    "calib_register_sensors": "sensor",
    "calib_register_metrics": "metric",
    "calib_register_datasets": "dataset",
    "calib_register_exporters": "exporter",
}
T = TypeVar("T")


@dataclass(frozen=True)
class Entry:
    """One thing that a plugin brought: what, and where from."""

    id: str
    kind: str
    item: Any
    distribution: str
    version: str
    source: str


class Registry:
    """Everything installed, by kind and id. Build one with :func:`registry`."""

    def __init__(self, entries: Sequence[Entry]) -> None:
        self.entries = tuple(entries)

    def _of(self, kind: str) -> dict[str, Any]:
        return {e.id: e.item for e in self.entries if e.kind == kind}

    @property
    def sensors(self) -> Mapping[str, Sensor]:
        """Sensor types by id."""
        return self._of("sensor")

    @property
    def metrics(self) -> Mapping[str, Metric | CostMetric]:
        """Appearance metrics by id."""
        return self._of("metric")

    @property
    def datasets(self) -> Mapping[str, Dataset]:
        """Readers of recordings by id."""
        return self._of("dataset")

    @property
    def exporters(self) -> Mapping[str, Exporter]:
        """Exporters by id."""
        return self._of("exporter")

    def sensor(self, kind: str, name: str) -> Sensor:
        """The sensor type that a stream of that kind needs. Raises PluginError."""
        try:
            return self.sensors[kind]
        except KeyError:
            raise PluginError(
                f"sensor {name} is of kind '{kind}', which no installed plugin reads (installed: "
                f"{', '.join(self.sensors)}); install one or pass --plugin FILE.py"
            ) from None

    def open_log(self, path: Path, format_id: str | None = None, **options: Any) -> Log:
        """The recording at a path, by the reader named or the one that recognises it. Raises DataError."""
        path = Path(path)
        try:
            path.exists()
        except OSError as e:  # of a name that is too long, or a folder that may not be looked into
            raise DataError(f"{path} can not be looked up ({e.strerror}); correct the path") from e
        context = ReadContext(self.sensors, self.open_log, options)
        readers = sorted(self.datasets.values(), key=lambda d: d.last)
        found = [d for d in readers if not d.last and d.matches(path)]
        found = found or [d for d in readers if d.last and d.matches(path)]
        if not path.exists() and not found:  # a path may go on inside a recording
            raise DataError(f"{path} does not exist; name the folder or file of a recording")
        if not found:
            refuse_packed(path)
        if format_id is not None:
            if format_id not in self.datasets:
                raise DataError(f"no reader is called '{format_id}'; there are: {', '.join(self.datasets)}")
            return self.datasets[format_id].open(path, context)
        if not found:
            wanted = "; ".join(f"{d.id} looks for {d.looks_for}" for d in readers)
            raise DataError(f"no reader knows {path}: {wanted}")
        if len(found) > 1:
            raise DataError(f"{path} looks like {' and like '.join(d.id for d in found)}; choose with --format")
        return found[0].open(path, context)

    def exporter(self, format_id: str) -> Exporter:
        """The exporter of that name. Raises DataError."""
        if format_id not in self.exporters:
            raise DataError(f"no exporter is called '{format_id}'; there are: {', '.join(self.exporters)}")
        return self.exporters[format_id]

    def exporter_of(self, path: Path) -> Exporter:
        """The one exporter that recognises what lies at a path. Raises DataError."""
        if not path.exists():
            raise DataError(f"{path} does not exist; name the file or folder of a calibration")
        found = [e for e in self.exporters.values() if e.matches(path)]
        if not found:
            wanted = "; ".join(f"{e.id} looks for {e.looks_for}" for e in self.exporters.values() if e.looks_for)
            raise DataError(f"no exporter knows {path} (choose with --from if it is one of these): {wanted}")
        if len(found) > 1:
            raise DataError(f"{path} looks like {' and like '.join(e.id for e in found)}; choose with --from")
        return found[0]


def registry(plugin_files: Iterable[Path] = ()) -> Registry:
    """The registry of everything installed, and of one-file plugins. Raises PluginError."""
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(HookSpecs)
    entries: list[Entry] = []
    for label, distribution, version, load in _found(plugin_files):
        module = _load(load, label)
        try:
            manager.register(module, name=label)
            manager.check_pending()
        except (pluggy.PluginValidationError, ValueError) as e:
            raise PluginError(f"plugin {label} does not fit the hooks: {' '.join(str(e).split())}") from e
        entries += _brought(manager, module, label, distribution, version)
    _refuse_duplicates(entries)
    return Registry(entries)


def _found(files: Iterable[Path]) -> Iterable[tuple[str, str, str, Callable[[], ModuleType]]]:
    """(label, distribution, version, loader) of every entry point, then of every file."""
    seen: set[tuple[str, str]] = set()
    for dist in distributions():
        points = dist.entry_points.select(group=GROUP)
        if not points:
            continue  # before its metadata are read, which is slow
        name, version = dist.metadata["Name"], dist.version
        for point in points:
            if (name, point.name) not in seen:  # an editable install can be listed twice
                seen.add((name, point.name))
                yield f"{point.value} of {name}", name, version, point.load
    for file in files:
        yield str(file), FILE, "-", partial(_module_from, file)


def _module_from(file: Path) -> ModuleType:
    if not file.is_file():
        raise PluginError(f"--plugin {file}: there is no such file")
    name = f"calib_toolkit_file_plugin_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise PluginError(f"--plugin {file}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    _send_by_value(module)
    return module


def _send_by_value(module: ModuleType) -> None:
    """Other processes can not import a loose file, so what it defines travels with the work."""
    import cloudpickle

    cloudpickle.register_pickle_by_value(module)


def _load(load: Callable[[], ModuleType], label: str) -> ModuleType:
    try:
        return load()
    except PluginError:
        raise
    except (Exception, SystemExit) as e:
        raise PluginError(
            f"plugin {label} could not be loaded ({type(e).__name__}: {e}); mend or uninstall it"
        ) from e


def _brought(
    manager: pluggy.PluginManager, module: ModuleType, label: str, dist: str, version: str
) -> Iterable[Entry]:
    unknown = [n for n in vars(module) if n.startswith("calib_register_") and n not in HOOKS]
    if unknown:
        raise PluginError(
            f"plugin {label} implements a hook that does not exist, {unknown[0]}; there are: {', '.join(HOOKS)}"
        )
    callers = manager.get_hookcallers(module) or []
    if not callers:
        raise PluginError(f"plugin {label} registers nothing; mark one of {', '.join(HOOKS)} with @hookimpl")
    for caller in callers:
        (impl,) = [i for i in caller.get_hookimpls() if i.plugin is module]
        for item in _items(impl.function, label, caller.name):
            if not isinstance(getattr(item, "id", None), str):
                raise PluginError(f"plugin {label}: what {caller.name} returns must have an id that is a string")
            if dist == FILE and isinstance(item, Sensor):  # a loose file changes without a new version
                item = replace(item, version=f"{item.version}+{crc32(Path(inspect.getfile(module)).read_bytes())}")
            yield Entry(item.id, HOOKS[caller.name], item, dist, version, inspect.getfile(module))


def _items(function: Callable[..., Any], label: str, hook: str) -> Sequence[Any]:
    try:
        items = function()
    except Exception as e:
        raise PluginError(f"plugin {label}: {hook} failed ({type(e).__name__}: {e}); mend or uninstall it") from e
    if not isinstance(items, list | tuple):
        raise PluginError(f"plugin {label}: {hook} must return a list, not {type(items).__name__}")
    return cast(Sequence[Any], items)


def _refuse_duplicates(entries: Sequence[Entry]) -> None:
    first: dict[tuple[str, str], Entry] = {}
    for e in entries:
        other = first.setdefault((e.kind, e.id), e)
        if other is not e:
            raise PluginError(
                f"two plugins bring a {e.kind} called '{e.id}': {other.source} ({other.distribution}) and "
                f"{e.source} ({e.distribution}); uninstall or rename one"
            )
