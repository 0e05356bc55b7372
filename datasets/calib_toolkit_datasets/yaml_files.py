"""Small YAML files, of plain values only."""

from pathlib import Path
from typing import Any

from calib_toolkit.errors import DataError

LARGEST = 1_000_000
"""Bytes; no description of a sensor is larger."""


def read_yaml(file: Path) -> dict[str, Any]:
    """The mapping that a file holds. Nothing in it is run: tags are refused. Raises DataError."""
    import yaml

    if not file.is_file():
        raise DataError(f"{file} is missing; fetch it")
    try:
        if file.stat().st_size > LARGEST:
            raise ValueError(f"it is larger than {LARGEST} bytes")
        text = file.read_text(encoding="utf-8-sig").removeprefix("%YAML:1.0")  # OpenCV's line is no YAML
        content = yaml.safe_load(text)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as e:
        why = " ".join(str(e).split())[:200]
        raise DataError(f"{file} can not be read as YAML of plain values ({why}); mend it") from e
    if not isinstance(content, dict):
        raise DataError(f"{file} holds no keys with values; mend it")
    return content
