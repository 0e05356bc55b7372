"""What the paper prints for its experiments, and what its author's published result files hold."""

from calib_toolkit.evaluation.errors import EULER, POSITION

WITHIN = {"initial": (43, 43), "nmi": (9, 84), "gom": (9, 89), "levinson": (13, 95), "im": (23, 100)}
"""Table I: per cent within 0.3 m and 2 degrees, searched everywhere and constrained by the motion."""
FULL = (0.063, 0.075, 0.020, 0.438, 0.415, 0.154)
"""Table II: mean absolute error of x, y, z in metres, of roll, pitch, yaw in degrees."""

PRINTED = {
    ("timing", "dt", 200.0, 1.0): "KITTI 6, worst 40; Shrimp 2, worst 9",
    ("pair", "rotation", 300.0, 0.0): "below 0.5 an axis on KITTI, below 2 on Shrimp",
    **{
        ("full", parameter, 100.0, 0.0): f"KITTI, mean {error:g}"
        for parameter, error in zip((*POSITION, *EULER), FULL, strict=True)
    },
}
"""As printed, by protocol, parameter, seconds and spread; medians in the units of the tables unless they say more."""

RECOMPUTED = {
    ("timing", "dt", 200.0, 1.0): "KITTI 13.1, p95 74.8; Shrimp 2.75, worst 14",
    ("timing", "dt", 100.0, 1.0): "KITTI 8.1",
    ("pair", "rotation", 100.0, 0.0): "velodyne-INS: KITTI 0.51, Shrimp 1.23; INS-camera: KITTI 0.69",
    ("pair", "translation", 100.0, 0.0): "velodyne-INS: KITTI 0.40, Shrimp 0.14; INS-camera: KITTI 1.27",
    ("pair", "rotation", 300.0, 0.0): "velodyne-INS: KITTI 0.31, Shrimp 1.16; INS-camera: KITTI 0.44",
    ("pair", "translation", 300.0, 0.0): "velodyne-INS: KITTI 0.31, Shrimp 0.12; INS-camera: KITTI 0.32",
    ("panoramic", "rotation", 30.0, 0.0): "Shrimp, means: together 1.69, separate 1.94",
}
"""From the result files that the author published, which do not always agree with the print."""


def beside(protocol: str, parameter: str, seconds: float, spread: float) -> str:
    """Both figures for one row of a table, or nothing."""
    key = (protocol, parameter, seconds, spread)
    files = f"his files: {RECOMPUTED[key]}" if key in RECOMPUTED else ""
    return "; ".join(text for text in (PRINTED.get(key, ""), files) if text)
