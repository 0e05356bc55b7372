"""What sensors that see the same place tell of each other's pose (section VII), bounded by what their motion told."""

from calib_toolkit.appearance.refinement import refine as refine
