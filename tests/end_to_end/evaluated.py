"""The command ``evaluate`` on small recordings, and what it wrote."""

import csv

from click.testing import CliRunner
from small_runs import SHARP_CAM, SHARP_INS, SHARP_VELO, recorded

from calib_toolkit import cli

CAM1 = """
[sensors.cam1]
pose = [0.2, 0.8, 1.1, -90.0, 0.0, -20.0]
dt = 0.025
has_scale = false
sigma = [0.005, 0.005, 0.005, 2e-4, 2e-4, 2e-4]
"""


def simulated(folder, seconds=45, seed=5, drive="rough"):
    """A recording with four sensors and its truth."""
    head = f'seconds = {seconds}\nseed = {seed}\ndrive = "{drive}"\n'
    return recorded(folder, head + SHARP_CAM + CAM1 + SHARP_VELO + SHARP_INS)


def evaluate(*arguments, status=0):
    """What the command printed."""
    done = CliRunner().invoke(cli.main, ["evaluate", *(str(a) for a in arguments)])
    assert done.exit_code == status, done.output
    return done.output


def refused(*arguments):
    """The sentence."""
    text = evaluate(*arguments, status=1)
    (sentence,) = [line for line in text.splitlines() if line.startswith("calib-toolkit: ")]
    return sentence.removeprefix("calib-toolkit: ")


def rows_of(file):
    with file.open(newline="") as f:
        return list(csv.DictReader(f))
