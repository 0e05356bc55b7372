"""Archives, compressed files and pickles as recordings: one sentence, nothing unpacked, nothing run."""

import bz2
import gzip
import io
import lzma
import os
import pickle
import tarfile
import zipfile

import pytest


class Trap:
    """Leaves a folder behind when its pickle is opened."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def zipped(path, names=("../../climbed", "rig.toml")):
    with zipfile.ZipFile(path, "w") as archive:
        for name in names:
            archive.writestr(name, "[sensors.velo]\n")


def tarred(path, mode="w"):
    with tarfile.open(path, mode) as archive:
        for name in ("../../climbed", "rig.toml"):
            member = tarfile.TarInfo(name)
            member.size = 1
            archive.addfile(member, io.BytesIO(b"x"))


WRITE = {
    "a.zip": zipped,
    "no ending": zipped,
    "a.bag": zipped,
    "a.tar": tarred,
    "a.tar.gz": lambda path: tarred(path, "w:gz"),
    "a.tgz": lambda path: tarred(path, "w:gz"),
    "a.tar.xz": lambda path: tarred(path, "w:xz"),
    "a.7z": lambda path: path.write_bytes(b"7z\xbc\xaf\x27\x1c" + bytes(60)),
    "a.rar": lambda path: path.write_bytes(b"Rar!\x1a\x07\x01\x00" + bytes(60)),
    "a.bag.gz": lambda path: path.write_bytes(gzip.compress(b"#ROSBAG V2.0\n")),
    "a.bag.bz2": lambda path: path.write_bytes(bz2.compress(b"#ROSBAG V2.0\n")),
    "a.mcap.xz": lambda path: path.write_bytes(lzma.compress(b"\x89MCAP0\r\n")),
    "a.mcap.zst": lambda path: path.write_bytes(b"\x28\xb5\x2f\xfd" + bytes(20)),
}
HOW = {
    "a.zip": "a zip archive, and recordings are not read out of those; unpack it (python -m zipfile -e a.zip FOLDER)",
    "no ending": "is a zip archive",
    "a.bag": "is a zip archive",
    "a.tar": "is a tar archive, and recordings are not read out of those; unpack it (tar xf a.tar)",
    "a.tar.gz": "a compressed tar archive, and recordings are not read out of those; unpack it (tar xf a.tar.gz)",
    "a.tgz": "unpack it (tar xf a.tgz)",
    "a.tar.xz": "unpack it (tar xf a.tar.xz)",
    "a.7z": "unpack it (7z x a.7z)",
    "a.rar": "unpack it (unrar x a.rar)",
    "a.bag.gz": "is compressed by gzip, and recordings are not read out of those; unpack it (gunzip -k a.bag.gz)",
    "a.bag.bz2": "unpack it (bunzip2 -k a.bag.bz2)",
    "a.mcap.xz": "unpack it (unxz -k a.mcap.xz)",
    "a.mcap.zst": "unpack it (unzstd a.mcap.zst)",
}


@pytest.mark.parametrize("name", WRITE)
def test_what_is_packed_is_refused_and_left_alone(refused, tmp_path, name):
    path = tmp_path / "in" / name
    path.parent.mkdir()
    WRITE[name](path)
    before = {p for p in tmp_path.rglob("*") if "out" not in p.parts}
    sentence = refused(path)
    assert sentence.count(str(path)) == 1
    assert HOW[name] in sentence
    assert "looks for" not in sentence
    assert not (tmp_path / "climbed").exists()
    assert {p for p in tmp_path.rglob("*") if p.name in ("climbed", "rig.toml")} <= before


@pytest.mark.parametrize("reader", ["folder", "rig", "rosbag1", "nuscenes", "kitti-raw"])
def test_a_reader_that_is_named_opens_no_archive_either(refused, tmp_path, reader):
    zipped(tmp_path / "a.zip")
    assert "is a zip archive" in refused(tmp_path / "a.zip", "--format", reader)


def test_a_stray_pickle_far_below_is_not_taken_for_the_recording(refused, tmp_path):
    (tmp_path / "a/b/c").mkdir(parents=True)
    (tmp_path / "a/b/c/cache.pkl").write_bytes(b"")
    assert "no reader knows" in refused(tmp_path / "a")


def test_an_archive_inside_a_recording_is_not_opened(refused, tmp_path):
    (tmp_path / "a").mkdir()
    zipped(tmp_path / "a/velo.zip")
    assert "no reader knows" in refused(tmp_path / "a")


@pytest.mark.parametrize("name", ["drive.pkl", "00.pkl.gz", "drive.pickle", "DRIVE.PKL"])
def test_a_pickle_is_never_opened(refused, tmp_path, name):
    raw = pickle.dumps(Trap(tmp_path / "sprung"))
    (tmp_path / name).write_bytes(gzip.compress(raw) if name.endswith("gz") else raw)
    sentence = refused(tmp_path / name)
    assert f"{tmp_path / name} is a pickle" in sentence
    assert "write its scans as .npy or .ply" in sentence
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("where", ["", "001", "001/lidar"])
def test_a_folder_of_pickles_as_pandaset_has_them(refused, tmp_path, where):
    folder = tmp_path / "set" / "001" / "lidar"
    folder.mkdir(parents=True)
    for k in range(3):
        (folder / f"{k:02d}.pkl.gz").write_bytes(gzip.compress(pickle.dumps(Trap(tmp_path / "sprung"))))
    (folder / "timestamps.json").write_text("[0.1, 0.2, 0.3]")
    camera = tmp_path / "set" / "001" / "camera" / "front_camera"
    camera.mkdir(parents=True)
    (camera / "poses.json").write_text("[]")
    path = tmp_path / "set" / where
    assert f"{path} holds pickles ({folder.relative_to(path) / '00.pkl.gz'})" in refused(path)
    assert not (tmp_path / "sprung").exists()
