"""MATLAB's files of version 5 (the layout of versions 6 and 7): whether their elements may be unpacked."""

import math
import struct
import zlib

HEADER = 128
NUMBERS = frozenset((*range(1, 8), 9, 12, 13, 16, 17, 18))
MATRIX, COMPRESSED = 14, 15
NESTED_CLASSES = (1, 2, 3)
"""Cells, structs and objects: the classes whose elements are matrices again."""
DEEPEST = 32


def refuse_damage(raw: bytes) -> None:
    """Raises ValueError where an element has no known type, says more than the file holds, or lies too deep.

    SciPy looks a type up in a table without asking whether it is there, which ends the process, and makes as many
    structs as a file says. ``raw``: all bytes of a file.
    """
    order = ">" if raw[126:128] == b"MI" else "<"
    for kind, body in _elements(raw[HEADER:], order):
        if kind == COMPRESSED:
            for inner, unpacked in _elements(zlib.decompress(body), order):
                _check(inner, unpacked, order, 0)
        else:
            _check(kind, body, order, 0)


def _check(kind: int, body: bytes, order: str, depth: int) -> None:
    if kind != MATRIX:
        raise ValueError(f"an element of type {kind} stands where a variable belongs")
    if not body:
        return  # how an empty array may be written
    if depth > DEEPEST:
        raise ValueError(f"its variables lie more than {DEEPEST} deep in one another")
    parts = _elements(body, order)
    flags = parts[0][1]
    nested = len(flags) == 8 and struct.unpack_from(f"{order}I", flags)[0] & 0xFF in NESTED_CLASSES
    dims = parts[1][1] if len(parts) > 1 else b""
    count = math.prod(struct.unpack(f"{order}{len(dims) // 4}i", dims[: len(dims) // 4 * 4]))
    if nested and count > len(body):
        raise ValueError(f"a variable says {count} parts in {len(body)} bytes")
    for inner, unpacked in parts:
        if inner == MATRIX and nested:
            _check(inner, unpacked, order, depth + 1)
        elif inner not in NUMBERS:
            raise ValueError(f"an element of type {inner} stands where numbers belong")


def _elements(raw: bytes, order: str) -> list[tuple[int, bytes]]:
    """Type and content of each element; up to four bytes may stand in the tag itself, others begin every 8 bytes."""
    found, at = [], 0
    while at < len(raw):
        if at + 8 > len(raw):
            raise ValueError("it ends within an element")
        kind, size = struct.unpack_from(f"{order}II", raw, at)
        start, small = at + 8, kind >> 16
        if small:
            kind, size, start = kind & 0xFFFF, small, at + 4
        if start + size > len(raw) or small > 4:
            raise ValueError(f"an element says {size} bytes and the file holds less")
        found.append((kind, raw[start : start + size]))
        at = at + 8 if small else start + size + (-size % 8 if kind != COMPRESSED else 0)
    return found
