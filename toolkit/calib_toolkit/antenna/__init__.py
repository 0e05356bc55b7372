"""Receivers that tell positions alone: where the antenna sits, and how late its clock is."""

from calib_toolkit.antenna.placing import added as added
