"""Small simulated recordings, as the text of their simulated.toml, and the command that calibrates one."""

import os
import subprocess
import sys
import time

import numpy as np
from click.testing import CliRunner

from calib_toolkit import cli

EPOCH = 1_317_000_000.0
DEEP = "x = " + "[" * 5000 + "]" * 5000
HEAD = "seconds = 40\nseed = 1\n"
VELO = "[sensors.velo]\npose = [0, 0, 1.7, 0, 0, 0]\n"
INS = "[sensors.ins]\npose = [-0.8, 0.3, 0.9, 0.8, -0.1, 1.0]\nrate = 20.0\ndt = -0.06\n"
CAM = "[sensors.cam0]\npose = [0.3, 0.1, 1.6, -90.0, 0.0, -90.0]\nhas_scale = false\n"
CAM1 = "[sensors.cam1]\npose = [0.3, -0.4, 1.6, -90.0, 0.0, -120.0]\nhas_scale = false\n"
SHARP_VELO = VELO + "sigma = [0.004, 0.004, 0.004, 2e-4, 2e-4, 2e-4]\n"
SHARP_INS = INS + "sigma = [0.002, 0.002, 0.002, 1e-4, 1e-4, 1e-4]\n"
SHARP_CAM = CAM + "sigma = [0.005, 0.005, 0.005, 2e-4, 2e-4, 2e-4]\n"
STREET = HEAD + 'drive = "street"\n' + VELO + "[sensors.ins]\npose = [-0.8, 0.3, 0.9, 0.8, -0.1, 1.0]\n"


def recorded(folder, text):
    """A recording of that text in a folder that is made if it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "simulated.toml").write_text(text)
    return folder


def run(drive, out, *arguments, jobs=1):
    """``calib-toolkit run`` with its result in out: (exit status, what was printed, the file as text or "")."""
    command = ["run", drive, "-o", out, "--jobs", jobs, *arguments]
    done = CliRunner().invoke(cli.main, [str(a) for a in command])
    file = out / "calibration.json"
    return done.exit_code, done.output, file.read_text() if file.exists() else ""


def killed_when(ready, *arguments, **environment):
    """``calib-toolkit`` in a process of its own, killed at the first moment that ready() holds, within a minute."""
    command = [sys.executable, "-c", "from calib_toolkit.cli import main; main()", *map(str, arguments)]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env={**os.environ, **environment}
    )
    try:
        deadline = time.monotonic() + 60
        while not ready():
            assert process.poll() is None, "it ended before it could be killed"
            assert time.monotonic() < deadline, "it never came so far"
            time.sleep(0.01)
    finally:
        process.kill()
        process.wait()


def as_array(rows):
    """Rows of a result file; null is nan."""
    return np.array(rows, dtype=float)
