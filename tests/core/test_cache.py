"""What counts as the same work, and what is kept of it."""

import os
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from calib_toolkit import cache
from calib_toolkit.types import CameraIntrinsics, LazyReadings, Motions, Trajectory


def motions(n=3, has_scale=True):
    rng = np.random.default_rng(n)
    return Motions(
        np.arange(n) * 0.1,
        np.arange(1, n + 1) * 0.1,
        rng.normal(size=(n, 6)),
        np.eye(6) + np.zeros((n, 1, 1)),
        has_scale,
    )


def trajectory():
    return Trajectory(np.arange(4.0), np.tile(np.eye(4), (4, 1, 1)), np.ones((4, 6, 6)), np.zeros((4, 6, 6)))


def same(a, b):
    return type(a) is type(b) and all(np.array_equal(x, vars(b)[k]) for k, x in vars(a).items())


@dataclass(frozen=True)
class Options:
    gate: float = 0.2
    sigma: tuple[float, ...] = (0.1, 0.2)


@dataclass(frozen=True)
class OtherOptions:
    gate: float = 0.2
    sigma: tuple[float, ...] = (0.1, 0.2)


def read(path):
    return path.read_bytes()


def read_otherwise(path, flip=False):
    return path.read_bytes()[::-1]


@pytest.fixture
def files(tmp_path):
    folder = tmp_path / "scans"
    folder.mkdir()
    for k in range(3):
        (folder / f"{k}.bin").write_bytes(bytes([k]) * 20_000)
    return sorted(folder.iterdir())


# ---- keys


def test_equal_inputs_have_one_key(files):
    def key():
        return cache.key_of("velodyne", "1", Options(), "velo", np.arange(3.0), LazyReadings(read, files), None, True)

    assert key() == key()
    assert key().isalnum()


@pytest.mark.parametrize(
    "changed",
    [
        ("monocular", "1", Options(), "velo", np.arange(3.0), True),
        ("velodyne", "2", Options(), "velo", np.arange(3.0), True),
        ("velodyne", "1", Options(gate=0.3), "velo", np.arange(3.0), True),
        ("velodyne", "1", Options(sigma=(0.1, 0.3)), "velo", np.arange(3.0), True),
        ("velodyne", "1", OtherOptions(), "velo", np.arange(3.0), True),
        ("velodyne", "1", Options(), "velo2", np.arange(3.0), True),
        ("velodyne", "1", Options(), "velo", np.arange(3.0) + 1e-9, True),
        ("velodyne", "1", Options(), "velo", np.arange(3.0), False),
    ],
)
def test_whatever_is_different_has_another_key(changed):
    assert cache.key_of(*changed) != cache.key_of("velodyne", "1", Options(), "velo", np.arange(3.0), True)


def test_intrinsics_count():
    one = CameraIntrinsics(np.eye(3), np.zeros(5), (8, 4), np.ones((4, 8), dtype=np.uint8))
    assert cache.key_of(one) == cache.key_of(replace(one, K=np.eye(3)))
    for other in (replace(one, K=2 * np.eye(3)), replace(one, distortion=np.ones(5)), replace(one, mask=None)):
        assert cache.key_of(one) != cache.key_of(other)


@pytest.mark.parametrize("at", [0, 10_000, 19_999], ids=["head", "middle", "end"])
def test_a_file_that_was_written_again_is_another(files, at):
    before = cache.key_of(LazyReadings(read, files))
    content = bytearray(files[1].read_bytes())
    content[at] ^= 255
    written = files[1].stat().st_mtime_ns
    files[1].write_bytes(content)
    os.utime(files[1], ns=(written + 10**9,) * 2)
    assert cache.key_of(LazyReadings(read, files)) != before


@pytest.mark.parametrize("at", [0, 19_999], ids=["head", "end"])
def test_another_content_under_the_same_times_is_seen(files, at):
    before = cache.key_of(files[1])
    state = files[1].stat()
    content = bytearray(files[1].read_bytes())
    content[at] ^= 255
    files[1].write_bytes(content)
    os.utime(files[1], ns=(state.st_atime_ns, state.st_mtime_ns))
    assert cache.key_of(files[1]) != before


def test_a_file_counts_wherever_it_is_within_a_key(files):
    @dataclass(frozen=True)
    class Key:
        path: Path
        period: float

    keys = [[Key(f, 0.1) for f in files], [(f, 1) for f in files], [{"file": f} for f in files]]
    before = [cache.key_of(LazyReadings(read, k)) for k in keys]
    files[2].write_bytes(b"other")
    assert all(cache.key_of(LazyReadings(read, k)) != b for k, b in zip(keys, before, strict=True))


def test_how_readings_are_loaded_counts(files):
    loads = [read, read_otherwise, partial(read_otherwise, flip=True), partial(read_otherwise, flip=False)]
    assert len({cache.key_of(LazyReadings(load, files)) for load in loads}) == 4


def test_a_file_that_is_not_there_has_a_key_too(tmp_path):
    missing = cache.key_of(tmp_path / "x.bin")
    assert missing == cache.key_of(tmp_path / "x.bin")
    (tmp_path / "x.bin").write_bytes(b"now")
    assert cache.key_of(tmp_path / "x.bin") != missing


# ---- what is kept


@pytest.mark.parametrize("motion", [motions(), motions(has_scale=False), motions(0), trajectory()])
@pytest.mark.parametrize("notes", [(), ("left out: a.bin, frame 3", "übrig: ½ m")])
def test_what_is_stored_comes_back(tmp_path, motion, notes):
    cache.store(tmp_path, "abcd", motion, notes)
    back, said = cache.load(tmp_path, "abcd")
    assert same(motion, back)
    assert said == notes


def test_nothing_is_there_before_it_is_stored(tmp_path):
    assert cache.load(tmp_path / "nowhere", "abcd") is None


def test_storing_again_replaces_and_leaves_no_parts(tmp_path):
    cache.store(tmp_path, "abcd", motions(3), ())
    cache.store(tmp_path, "abcd", motions(5), ())
    assert len(cache.load(tmp_path, "abcd")[0]) == 5
    assert [f.suffix for f in tmp_path.rglob("*") if f.is_file()] == [".npz"]


def test_half_a_store_is_not_seen(tmp_path, monkeypatch):
    def killed(*args, **kwargs):
        args[0].write(b"PK half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", killed)
    with pytest.raises(KeyboardInterrupt):
        cache.store(tmp_path, "abcd", motions(), ())
    assert cache.load(tmp_path, "abcd") is None


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9, 0.99])
def test_a_file_cut_short_counts_as_none(tmp_path, share):
    cache.store(tmp_path, "abcd", motions(), ("a note",))
    (file,) = tmp_path.rglob("*.npz")
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    assert cache.load(tmp_path, "abcd") is None


def test_a_flipped_bit_is_never_believed(tmp_path):
    cache.store(tmp_path, "abcd", motions(), ("a note",))
    (file,) = tmp_path.rglob("*.npz")
    content = file.read_bytes()
    for at in range(0, len(content), 37):
        file.write_bytes(content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :])
        found = cache.load(tmp_path, "abcd")
        assert found is None or (same(found[0], motions()) and found[1] == ("a note",)), at


def test_pickles_are_not_opened(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the pickle was opened",))

    values = {f: np.asarray(v) for f, v in vars(motions()).items()}
    file = tmp_path / "ab/abcd.npz"
    file.parent.mkdir()
    trap = np.array([Trap()], dtype=object)
    np.savez(file, kind=np.array("Motions"), notes=trap, **values)
    assert cache.load(tmp_path, "abcd") is None


# ---- where


def test_the_folder_is_the_users_or_the_one_chosen(monkeypatch, tmp_path):
    monkeypatch.delenv("CALIB_TOOLKIT_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert cache.default_folder() == Path.home() / ".cache/calib-toolkit"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.default_folder() == tmp_path / "calib-toolkit"
    monkeypatch.setenv("CALIB_TOOLKIT_CACHE", str(tmp_path / "mine"))
    assert cache.default_folder() == tmp_path / "mine"
