"""Compressed chunks, unpacked to no more than they say they hold."""

from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from calib_toolkit_datasets.bags.index import LARGEST, Damaged, Key


def read(file: IO[bytes], size: int, left: int) -> bytes:
    """So many bytes of a file of which so many are left. Raises Damaged."""
    if size > left:
        raise Damaged(f"it ends at byte {file.tell() + left}, in the middle of a record of {size} bytes")
    if size > LARGEST:
        raise Damaged(f"the record at byte {file.tell()} says it has {size} bytes, more than any message")
    data = file.read(size)
    if len(data) < size:
        raise Damaged(f"it ends at byte {file.tell()}, in the middle of a record of {size} bytes")
    return data


def unpack(data: bytes, compression: str, size: int) -> bytes:
    """A chunk of ``size`` bytes once unpacked. compression: "", none, bz2, lz4 or zstd. Raises Damaged."""
    if compression in ("", "none"):
        whole = data
    elif size > LARGEST:
        raise Damaged(f"a chunk says it has {size} bytes, more than is held in memory")
    else:
        try:
            whole = _unpacker(compression).decompress(data, max_length=size + 1) if size else b""
        except Damaged:
            raise
        except Exception as e:  # each library has errors of its own
            raise Damaged(f"a chunk of {compression} can not be unpacked ({type(e).__name__}: {e})") from e
    if len(whole) != size:
        raise Damaged(f"a chunk holds {len(whole)} bytes or more where it says {size}")
    return whole


def _unpacker(compression: str) -> Any:
    if compression == "bz2":
        import bz2

        return bz2.BZ2Decompressor()
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor()
    if compression == "zstd":
        return zstd().ZstdDecompressor()
    raise Damaged(f"a chunk is compressed by '{compression}', which is unknown; known are bz2, lz4 and zstd")


def zstd() -> Any:
    """The module of that name, of Python or its backport."""
    import sys

    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        from backports import zstd as module
    return module


def size_of(file: Path) -> int:
    """Bytes of a file."""
    return file.stat().st_size


def message(path: Path, key: Key, chunk: Callable[[Path, int], bytes]) -> bytes:
    """The bytes of one message, in a chunk (unpacked by ``chunk``) or in the file. Raises Damaged or OSError."""
    _, at, start, length = key
    if at:
        return chunk(path, at)[start : start + length]
    with path.open("rb") as file:
        file.seek(start)
        return read(file, length, size_of(path) - start)
