"""Files damaged at random: a sentence or a rig, never a traceback, and never a rig when a part is missing."""

from collections import Counter

import numpy as np
import pytest
from exported_rigs import FORMATS, ordinary, same

from calib_toolkit import CalibrationError

HOSTILE = (b"nan", b"1e999", b"-", b"[", b"{", b": ", b"!!python/name:os.system", b"&a ", b"*a", b"\0", b"9" * 5000)


def damaged(data, rng):
    """Bytes flipped, swapped, doubled or dropped, numbers exchanged, lines lost."""
    data, kind = bytearray(data), rng.integers(7)
    i, j = sorted(rng.integers(0, len(data), 2))
    if kind == 0:
        for k in rng.integers(0, len(data), rng.integers(1, 4)):
            data[k] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        data = data[:i]
    elif kind == 2:
        del data[i : min(j, i + 40)]
    elif kind == 3:
        data[i:i] = data[i : min(j, i + 200)]
    elif kind == 4:
        words = bytes(data).split(b" ")
        a, b = rng.integers(0, len(words), 2)
        words[a], words[b] = words[b], words[a]
        data = bytearray(b" ".join(words))
    elif kind == 5:
        lines = bytes(data).split(b"\n")
        del lines[int(rng.integers(len(lines)))]
        data = bytearray(b"\n".join(lines))
    else:
        data[i:i] = HOSTILE[int(rng.integers(len(HOSTILE)))]
    return bytes(data)


def outcomes(exporting, format_id, count):
    """How many files were refused, were read as they had been, or as another rig."""
    rig = ordinary(format_id)
    path = exporting.write(rig, format_id)
    files = sorted(f for f in exporting.folder.rglob("*") if f.is_file())
    whole = {f: f.read_bytes() for f in files}
    rng, found = np.random.default_rng(11), Counter()
    for _ in range(count):
        file = files[int(rng.integers(len(files)))]
        file.write_bytes(damaged(whole[file], rng))
        try:
            back = exporting.read(path, format_id)
        except CalibrationError as e:
            found["refused"] += 1
            found["long"] += len(str(e)) > 1000 or "\n" in str(e)
        else:
            assert np.all(np.isfinite(back.T_base_sensor))
            R = back.T_base_sensor[:, :3, :3]
            assert np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), atol=1e-9)
            assert np.allclose(np.linalg.det(R), 1.0)
            try:
                found["the same"] += same(rig, back)
            except AssertionError:
                found["another"] += 1
        file.write_bytes(whole[file])
    assert found.pop("long", 0) == 0
    return found


@pytest.mark.parametrize("format_id", FORMATS)
def test_no_damage_gives_a_traceback(exporting, format_id):
    found = outcomes(exporting, format_id, 60)
    assert found["refused"] > 10


@pytest.mark.long
@pytest.mark.parametrize("format_id", FORMATS)
def test_no_damage_gives_a_traceback_in_a_thousand_files(exporting, format_id):
    found = outcomes(exporting, format_id, 1000)
    print(format_id, dict(found))
    assert sum(found.values()) == 1000


@pytest.mark.parametrize("format_id", FORMATS)
def test_a_part_of_a_file_is_never_a_rig(exporting, format_id):
    """Wherever a file is cut, it is refused, unless only blanks are missing; so nothing goes missing in silence."""
    rig = ordinary(format_id)
    path = exporting.write(rig, format_id)
    files = [path] if path.is_file() else [f for f in path.iterdir() if "calib" in f.name]
    rng = np.random.default_rng(4)
    for file in files:
        whole = file.read_bytes()
        for at in rng.integers(80, len(whole.rstrip()), 12):
            file.write_bytes(whole[:at])
            with pytest.raises(CalibrationError):
                exporting.read(path, format_id)
        file.write_bytes(whole)
    assert same(rig, exporting.read(path, format_id))
