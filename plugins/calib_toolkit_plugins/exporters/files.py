"""Text, YAML and JSON of calibrations: bounded, without tags, nothing twice; and the comments in what is written."""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from calib_toolkit.errors import DataError

LARGEST = 16 * 2**20
"""Bytes of a file that may be a calibration."""
HEAD = 2**16
"""Characters by which a format is recognised."""
FURTHEST = 1e6
"""No number of a rig is larger: metres, radians, seconds."""
WRITTEN, END = "written by calib-toolkit", "end of file"
"""In the first and in the last line of what was written; a file with one of them only was cut short."""
EXPONENT = re.compile(r"[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+")  # a number that YAML 1.1 takes for a word


def head(path: Path) -> str:
    """The beginning of a file, empty if it can not be read; never raises."""
    try:
        with path.open("rb") as file:
            return file.read(HEAD).decode("utf-8", errors="replace")
    except OSError:
        return ""


def text(file: Path) -> str:
    """The whole of a file. Raises DataError if it is not text, too large to be a calibration, or cut short."""
    try:
        if file.stat().st_size > LARGEST:
            raise DataError(f"{file} has {file.stat().st_size >> 20} MB, which no calibration has; name another file")
        content = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as e:
        raise DataError(f"{file} can not be read as text ({type(e).__name__}); name a text file") from e
    lines = content.rstrip().split("\n")
    if lines[0].startswith(("#", "comment:")) and WRITTEN in lines[0] and not lines[-1].endswith(END):
        raise DataError(f"{file} is cut short: its last line, '{END}', is missing; fetch or export it again")
    return content


def load_yaml(file: Path) -> Any:
    """What stands in a YAML file; a list where it holds several documents. Raises DataError."""
    content = text(file)
    if content.startswith("%YAML:"):  # as OpenCV writes it, which is not YAML
        content = content.partition("\n")[2].removeprefix("---\n")
    try:
        found = [d for d in yaml.load_all(content, Loader=_Loader) if d is not None]  # a SafeLoader
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError, KeyError, TypeError, AttributeError) as e:
        raise DataError(f"{file} is not plain YAML ({_short(e)}); correct it or fetch it again") from e
    return found[0] if len(found) == 1 else found


def load_json(file: Path) -> Any:
    """What stands in a JSON file. Raises DataError."""
    try:
        return json.loads(text(file), object_pairs_hook=_once, parse_constant=_no_constant)
    except (ValueError, RecursionError) as e:
        raise DataError(f"{file} is not JSON ({_short(e)}); correct it or fetch it again") from e


def number(file: Path, what: str, value: Any) -> float:
    """A finite number of a sensible size. Raises DataError."""
    if isinstance(value, str) and EXPONENT.fullmatch(value):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= FURTHEST:
        raise DataError(f"{file}: {what} is {_show(value)}, which is no number of a rig; correct it")
    return float(value)


def numbers(file: Path, what: str, values: Any, count: int) -> list[float]:
    """So many numbers of a list. Raises DataError."""
    if not isinstance(values, list | tuple) or len(values) != count:
        raise DataError(f"{file}: {what} is {_show(values)}, where a list of {count} numbers belongs; correct it")
    return [number(file, what, v) for v in values]


def entry(file: Path, what: str, table: Any, key: str) -> Any:
    """An entry that must be there. Raises DataError."""
    if not isinstance(table, dict) or key not in table:
        raise DataError(f"{file}: {what} has no {key}; add it, or fetch the file again")
    return table[key]


def name(file: Path, what: str, value: Any) -> str:
    """The name of a sensor or frame. Raises DataError."""
    if not isinstance(value, str) or not value or not value.isprintable() or value != value.strip():
        raise DataError(f"{file}: {what} is {_show(value)}, which is not the name of a sensor or frame; correct it")
    return value


def write_yaml(file: Path, sentences: Iterable[str], content: Any) -> None:
    """A YAML file that begins with comments and ends with one."""
    body = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=200)
    file.write_text(comments(sentences) + body + f"# {END}\n", encoding="utf-8")


def comments(sentences: Iterable[str]) -> str:
    """Lines of a comment, the first of which says who wrote them."""
    first, *others = sentences
    return "".join(f"# {line}\n" for line in (f"{first}, {WRITTEN}.", *others))


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Plain YAML: no tags, no key twice, no merging (which can blow a small file up)."""

    def flatten_mapping(self, node: Any) -> None:
        if any(key.tag == "tag:yaml.org,2002:merge" for key, _ in node.value):
            raise ValueError("it merges tables with <<")

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        found: dict[Any, Any] = super().construct_mapping(node, deep)
        if isinstance(node, yaml.MappingNode) and len(found) < len(node.value):
            raise ValueError(f"a table has a key twice, line {node.start_mark.line + 1}")
        return found


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a table has a key twice")
    return found


def _no_constant(word: str) -> Any:
    raise ValueError(f"{word} is no number")


def _short(e: Exception) -> str:
    return " ".join(str(e).split())[:150] or type(e).__name__


def _show(value: Any) -> str:
    try:
        shown = repr(value)
    except (ValueError, RecursionError):  # thousands of digits
        shown = type(value).__name__
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
