"""How fast recordings are read, against a plain read of the same bytes, and the memory that converting takes.

    .venv/bin/python docs/results/reading.py DRIVE [FOLDER]

DRIVE is converted to every format that can be written, in FOLDER (default: a temporary one), by a process
of its own each.
"""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from calib_toolkit import open_log
from calib_toolkit.plugins import registry

NAMES = {
    "rosbag1": "drive.bag",
    "rosbag2": "drive",
    "mcap": "drive.mcap",
    "kitti-raw": "kitti",
    "nuscenes": "nuscenes",
}
BLOCK = 2**20


def main() -> None:
    """Convert, then read each; processor seconds, the files being in the system's cache: no disk is measured."""
    drive = Path(sys.argv[1])
    folder = Path(sys.argv[2] if len(sys.argv) > 2 else tempfile.mkdtemp())
    print("format      MB  convert s  peak MB    plain s   open s   read s  read/plain")
    for target, name in NAMES.items():
        path = folder / name
        seconds, peak = converted(drive, path, target) if not path.exists() else (float("nan"), float("nan"))
        files = [f for f in path.rglob("*") if f.is_file()] if path.is_dir() else [path]
        inside = next(path.glob("*_extract"), path) if path.is_dir() else path
        size = sum(f.stat().st_size for f in files)
        plain(files)
        bare = plain(files)
        opened, read = readings(inside)
        numbers = f"{size / 1e6:6.0f}{seconds:11.1f}{peak:9.0f}{bare:11.3f}{opened:9.3f}{read:9.3f}"
        print(f"{target:9}{numbers}{(opened + read) / bare:12.1f}")


def converted(drive: Path, path: Path, target: str) -> tuple[float, float]:
    """Seconds, and the largest memory in megabytes, of a process that converts."""
    start = time.perf_counter()
    command = "import sys, resource; from calib_toolkit.cli import main\ntry: main(sys.argv[1:])\nfinally: "
    command += "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    done = subprocess.run(
        [sys.executable, "-c", command, "convert", drive, path, "--to", target],
        capture_output=True,
        text=True,
        check=False,
    )
    return time.perf_counter() - start, float(done.stdout.splitlines()[-1])


def plain(files: list[Path]) -> float:
    """Seconds to read the bytes."""
    start = time.process_time()
    for file in files:
        with file.open("rb", buffering=0) as f:
            while f.read(BLOCK):
                pass
    return time.process_time() - start


def readings(path: Path) -> tuple[float, float]:
    """Seconds to open a recording, and to load every reading of every sensor."""
    plugins = registry()
    open_log(path, plugins=plugins)  # libraries are loaded
    start = time.process_time()
    log = open_log(path, plugins=plugins)
    opened = time.process_time() - start
    for stream in log.streams.values():
        for k in range(len(stream)):
            stream.readings[k]
    return opened, time.process_time() - start - opened


if __name__ == "__main__":
    main()
    print(f"peak of this process {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
