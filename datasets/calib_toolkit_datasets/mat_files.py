"""MATLAB's files of version 5 (the layout of versions 6 and 7): whether their elements may be unpacked."""

import math
import struct
import zlib

HEADER = 128
BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
"""Of a number, by the type of its element."""
INT8, INT32, UINT32 = 1, 5, 6
MATRIX, COMPRESSED = 14, 15
CELL, STRUCT, ARRAYS = 1, 2, (4, *range(6, 16))
"""Classes of variables: lists, structs, and text or numbers. Files of motions hold no others."""
COMPLEX = 0x0800
"""In the flags that hold the class."""
DEEPEST = 32


def refuse_damage(raw: bytes) -> None:
    """Raises ValueError unless each variable has all its parts, of the types and sizes that they must have.

    SciPy takes that for granted: where it is not so, the process may end. ``raw``: all bytes of a file.
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
    if [kind for kind, _ in parts[:3]] != [UINT32, INT32, INT8] or len(parts[0][1]) != 8 or len(parts[1][1]) % 4:
        raise ValueError("a variable does not begin with its class, size and name")
    (flags,) = struct.unpack_from(f"{order}I", parts[0][1])
    sizes = struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1])
    count = math.prod(sizes)
    if len(sizes) < 2 or min(sizes) < 0 or count > len(body):
        raise ValueError(f"a variable says {count} parts in {len(body)} bytes")
    held, of_class = parts[3:], flags & 0xFF
    if of_class in ARRAYS:
        _check_array(held, count, bool(flags & COMPLEX))
        return
    if of_class not in (CELL, STRUCT):
        raise ValueError(f"a variable of class {of_class} is neither numbers, text, a cell nor a struct")
    if of_class == STRUCT:
        held, count = parts[5:], count * _fields(parts[3:5], order)
    if len(held) != count:
        raise ValueError(f"a variable says {count} parts and has {len(held)}")
    for inner, unpacked in held:
        _check(inner, unpacked, order, depth + 1)


def _check_array(parts: list[tuple[int, bytes]], count: int, has_imaginary: bool) -> None:
    """The numbers, or the letters, of an array of so many, and their imaginary parts."""
    if len(parts) != 1 + has_imaginary or any(len(body) != count * BYTES.get(kind, 0) for kind, body in parts):
        raise ValueError(f"an array of {count} numbers holds something else")


def _fields(parts: list[tuple[int, bytes]], order: str) -> int:
    """How many fields a struct has, by the length of a name and all names."""
    if [kind for kind, _ in parts] != [INT32, INT8] or len(parts[0][1]) != 4:
        raise ValueError("a struct has no names of fields")
    (length,) = struct.unpack(f"{order}i", parts[0][1])
    if length < 1 or len(parts[1][1]) % length:
        raise ValueError(f"a struct's names of {length} letters fill {len(parts[1][1])}")
    return len(parts[1][1]) // length


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
