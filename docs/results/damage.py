"""What readers make of damaged files: ``python docs/results/damage.py RECORDING... [--count 1000]``.

Each time one file of a recording is cut short, loses a part or has some bytes changed; all of it is then read and
compared with what was there before. Prints, as Markdown, how many were refused, how many opened with a sentence
about what is missing, and how many read as before, read as less or read otherwise, without a word.
"""

import hashlib
import shutil
import tempfile
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from summaries import table, tell

from calib_toolkit import DataError, open_log
from calib_toolkit.plugins import Registry, registry

OUTCOMES = ("refused", "told", "as before", "less, unsaid", "otherwise, unsaid", "traceback")
WORDS = (b"\xff" * 4, bytes(4), b"\x00\x00\x00\x80", b"nan ", b"-1e9", b",,,,", b"\n\n  ", b"!!a ", b"../.", b"9999")


@click.command(context_settings={"show_default": True})
@click.argument("recordings", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--count", type=click.IntRange(1), default=1000, help="Damaged files of each recording.")
@click.option("--beside", is_flag=True, help="Damage what lies beside a recording, too, as KITTI's calibration does.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Of the damage.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Write the table, too.")
def main(recordings: Sequence[Path], count: int, beside: bool, seed: int, out: Path | None) -> None:
    """A row for each recording."""
    rows = []
    for recording in recordings:
        with tempfile.TemporaryDirectory() as scratch:
            top = recording.parent if beside else recording
            copy = Path(scratch) / top.name
            (shutil.copytree if top.is_dir() else shutil.copy)(top, copy)
            found = Counter(damaged(copy / recording.relative_to(top), copy, count, seed))
        rows.append([recording.name, len(open_log(recording).streams), *(found[o] for o in OUTCOMES)])
        click.echo(" ".join(map(str, rows[-1])), err=True)
    tell(table(f"{count} damaged files of each", ("recording", "sensors", *OUTCOMES), rows), out)


def damaged(recording: Path, top: Path, count: int, seed: int) -> Iterator[str]:
    """Outcomes of so many damaged files among those of top, each of which is mended again."""
    rng, plugins = np.random.default_rng(seed), registry()
    files = sorted(f for f in top.rglob("*") if f.is_file()) if top.is_dir() else [top]
    # a folder of a thousand images is damaged as often as one table
    folders = sorted({(f.parent, f.suffix) for f in files})
    by_folder = [[f for f in files if (f.parent, f.suffix) == kind] for kind in folders]
    whole, notes = read(recording, plugins)
    assert whole == read(recording, plugins)[0], "reading twice does not give the same"
    for _ in range(count):
        among = by_folder[rng.integers(len(by_folder))]
        file = among[rng.integers(len(among))]
        raw = file.read_bytes()
        try:
            file.write_bytes(mutated(raw, rng))
            found, said = read(recording, plugins)
            if found == whole:
                yield "as before"
            elif set(said) - set(notes):
                yield "told"
            else:
                yield "less, unsaid" if found.items() <= whole.items() else "otherwise, unsaid"
        except DataError:
            yield "refused"
        except Exception:  # what must never happen is counted and shown
            traceback.print_exc()
            yield "traceback"
        finally:
            file.write_bytes(raw)


def mutated(raw: bytes, rng: np.random.Generator) -> bytes:
    """Bytes cut short, with a part gone, with some bits turned, or with words that should not be there."""
    data, kind = bytearray(raw), rng.integers(4)
    if not raw or kind == 0:
        return bytes(data[: rng.integers(len(raw) + 1)])
    if kind == 1:
        at = rng.integers(len(raw))
        del data[at : at + rng.integers(1, 64)]
        return bytes(data)
    for _ in range(rng.integers(1, 8)):
        at = int(rng.integers(max(len(raw) - 4, 1)))
        if kind == 2:
            data[at] ^= 1 << int(rng.integers(8))
        else:
            data[at : at + 4] = WORDS[rng.integers(len(WORDS))]
    return bytes(data)


def read(path: Path, plugins: Registry) -> tuple[dict[Any, bytes], list[str]]:
    """Digests of all that a recording says, by sensor and stamp, and every sentence about it. Raises DataError."""
    log = open_log(path, plugins=plugins)
    said, found = [*log.notes, *(t.unused for t in log.topics)], {"reference": digest(log.reference)}
    for name, stream in log.streams.items():
        said += stream.notes
        found[name] = digest((stream.kind, stream.intrinsics, stream.has_scale, dict(stream.options)))
        for k, t in enumerate(stream.stamps):
            try:
                found[name, log.epoch_ns + round(1e9 * t)] = digest(stream.readings[k])
            except DataError as e:
                said.append(str(e))
    return found, said


def digest(value: Any) -> bytes:
    """Of every number in it."""
    return hashlib.sha1(b"".join(_parts(value)), usedforsecurity=False).digest()


def _parts(value: Any) -> Iterator[bytes]:
    if is_dataclass(value):
        for field in fields(value):
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        yield str((value.shape, value.dtype)).encode() + value.tobytes()
    elif isinstance(value, tuple | list):
        for each in value:
            yield from _parts(each)
    elif isinstance(value, dict):
        yield from _parts(sorted(value.items(), key=str))
    else:
        yield repr(value).encode()


if __name__ == "__main__":
    main()
