"""One consistent rig out of the motion result and what every pair of sensors looks like (section VII-D)."""

from calib_toolkit.combine.combined import Combined as Combined
from calib_toolkit.combine.combined import combine as combine
from calib_toolkit.combine.simplex import combine_paper as combine_paper
