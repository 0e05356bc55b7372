"""The tables of docs/results, from the real recordings: ``python docs/results/make.py NAME RECORDINGS``.

NAME is timing, pair, panoramic, whole or cost. RECORDINGS is the folder that holds multi-array-calib/ and
kitti-drive-0027/. Each prints one Markdown table; sections are drawn at random with a fixed seed.
"""

import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path

import joblib
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import (
    Calibration,
    CalibrationError,
    Config,
    Motions,
    calibrate_motions,
    observability,
    open_log,
    se3,
    sync,
)
from calib_toolkit import timing as timing_stage
from calib_toolkit.pipeline import sensor_motions
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Silent

Array = NDArray[np.float64]
Drive = dict[str, Motions]

TRUE_OFFSETS = {"KITTI": np.array([0.0, 0.0, 6.14e-3, 6.70e-3]), "Shrimp": np.zeros(5)}
"""Cameras' clocks against camera 0's, seconds: each rig's cameras are triggered together."""
AUTHOR_TIMING = {("KITTI", 200): "13.1 / 74.8 / -", ("KITTI", 100): "8.1 / - / -", ("Shrimp", 200): "2.75 / - / 14"}


@cache
def drive(recordings: Path, rig: str) -> Drive:
    """Every sensor's motions of a whole drive."""
    if rig == "KITTI+INS":
        with tempfile.TemporaryDirectory() as folder:
            log = open_log(_rig_with_ins(Path(folder), recordings))
    else:
        log = open_log(recordings / "multi-array-calib" / rig.lower())
    moved = sensor_motions(log, Config(jobs=1), registry(), Silent(), Path(tempfile.gettempdir()))
    return {name: m.motions for name, m in moved.items()}


def truth(recordings: Path) -> dict[str, Array]:
    """The author's ground truth, (4, 4) poses; ``ladybug`` (5, 4, 4)."""
    stored = json.loads((recordings / "multi-array-calib" / "ground_truth.json").read_text())
    poses = {k: se3.matrix(v) for k, v in stored["kitti_2011_10_03"].items()}
    poses["shrimp"] = se3.matrix(stored["shrimp_velNav"])
    poses["ladybug"] = se3.matrix(stored["shrimp_ladybug_cam_to_body_6vec"])
    return poses


def sections(
    motions: Drive, seconds: float, repeats: int, seed: int = 0
) -> Iterator[tuple[Drive, np.random.Generator]]:
    """Random stretches of a drive, each with a generator of its own."""
    first, last = max(m.start[0] for m in motions.values()), min(m.end[-1] for m in motions.values())
    for i in range(repeats):
        rng = np.random.default_rng([seed, int(seconds), i])
        start = rng.uniform(first, max(last - seconds, first))
        inside = {n: (m.start >= start) & (m.end <= start + seconds) for n, m in motions.items()}
        yield {n: m[inside[n]] for n, m in motions.items()}, rng


def timing(recordings: Path, repeats: int = 100) -> None:
    """Fig. 6: random offsets applied to the cameras, and found again."""
    print("| rig | seconds | applied | median ms | p95 ms | worst ms | refused | author's median / p95 / worst |")
    print("|---|---|---|---|---|---|---|---|")
    for rig, count in (("KITTI", 4), ("Shrimp", 5)):
        cameras = {f"cam{i}": drive(recordings, rig)[f"cam{i}"] for i in range(count)}
        for spread, lengths in ((1.0, (10, 30, 100, 200)), (0.1, (100,))):
            for seconds in lengths:
                jobs = (
                    joblib.delayed(_timing_errors)(s, r, spread, TRUE_OFFSETS[rig])
                    for s, r in sections(cameras, seconds, repeats)
                )
                found = [e for e in joblib.Parallel(2)(jobs) if e is not None]
                e = 1e3 * np.abs(np.concatenate(found))
                numbers = f"{np.median(e):.2f} | {np.percentile(e, 95):.2f} | {e.max():.2f} | {repeats - len(found)}"
                theirs = AUTHOR_TIMING.get((rig, seconds), "") if spread == 1.0 else ""
                print(f"| {rig} | {seconds} | +-{spread:g} s | {numbers} | {theirs} |", flush=True)


def _timing_errors(cameras: Drive, rng: np.random.Generator, spread: float, true: Array) -> Array | None:
    applied = np.concatenate([[0.0], rng.uniform(-spread, spread, len(cameras) - 1)])
    chains = [sync.chain(m.shifted(d)) for m, d in zip(cameras.values(), applied, strict=True)]
    try:
        found = timing_stage.estimate(chains, list(cameras), timing_stage.TimingOptions())
    except CalibrationError:
        return None
    on_base = [c.shifted(d) for c, d in zip(chains, found.dt, strict=True)]
    if observability.unmeasured_times(list(cameras), on_base, list(cameras)):
        return None
    return (found.dt + applied - true)[1:]


def pair(recordings: Path, repeats: int = 30) -> None:
    """Fig. 7: two sensors over drives of growing length, with the stated sigma; medians of absolute errors."""
    print(
        "| rig | sensors | seconds | rotation deg | translation m | roll, pitch, yaw deg | x, y, z m |"
        " sigma of these | within 1, 2 sigma % | undetermined or refused |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    poses = truth(recordings)
    chain = se3.invert(poses["velNav"]) @ poses["velCam1"]
    for rig, names, true, lengths in (
        ("Shrimp", ("velo", "ins"), poses["shrimp"], (10, 20, 50, 100, 150, 200, 300, 450)),
        ("KITTI+INS", ("velo", "ins"), poses["velNav"], (10, 20, 50, 100, 150, 200, 300)),
        ("KITTI+INS", ("ins", "cam0"), chain, (100, 300)),
    ):
        both = {n: drive(recordings, rig)[n] for n in names}
        for seconds in lengths:
            jobs = (joblib.delayed(_pair_errors)(s, true) for s, _ in sections(both, seconds, repeats))
            rows = [r for r in joblib.Parallel(2)(jobs) if r is not None]
            if not rows:
                print(f"| {rig} | {'-'.join(names)} | {seconds} | | | | | | | {repeats} of {repeats} |", flush=True)
                continue
            total, error, sigma = (np.array(x) for x in zip(*rows, strict=True))
            error, told = error[:, :6], error[:, 6]
            inside = np.abs(error / sigma)
            print(
                f"| {rig} | {'-'.join(names)} | {seconds} | {np.median(total[:, 0]):.2f} |"
                f" {np.median(total[:, 1]):.2f} |"
                f" {_numbers(np.median(np.abs(error[:, :3]), axis=0), 2)} |"
                f" {_numbers(np.median(np.abs(error[:, 3:]), axis=0), 2)} | {_numbers(np.median(sigma, axis=0), 2)} |"
                f" {100 * np.mean(inside < 1):.0f}, {100 * np.mean(inside < 2):.0f} |"
                f" {repeats - int(told.sum())} of {repeats} |",
                flush=True,
            )


def _pair_errors(both: Drive, true: Array) -> tuple[Array, Array, Array] | None:
    """(2,) total degrees and metres; (7,) errors and whether all were determined; (6,) their sigma.

    None if the drive was refused.
    """
    try:
        c = calibrate_motions(both, Config()).calibration
    except CalibrationError:
        return None
    delta = np.degrees(se3.log_so3(true[:3, :3] @ c.T_base_sensor[1, :3, :3].T))
    shift = c.T_base_sensor[1, :3, 3] - true[:3, 3]
    total = np.array([np.linalg.norm(delta), np.linalg.norm(shift)])
    sigma = np.sqrt(np.diag(c.covariance)[7:14])
    return (
        total,
        np.concatenate([delta, shift, [c.determined.all()]]),
        np.concatenate([np.degrees(sigma[3:6]), sigma[:3]]),
    )


def panoramic(recordings: Path, repeats: int = 100) -> None:
    """Fig. 8: rotations of the ladybug's five level cameras from 30 s, all together and each with the first."""
    cameras = {f"cam{i}": drive(recordings, "Shrimp")[f"cam{i}"] for i in range(5)}
    true = truth(recordings)["ladybug"][:, :3, :3]
    jobs = (joblib.delayed(_panoramic_errors)(s, true) for s, _ in sections(cameras, 30, repeats))
    rows = np.array([r for r in joblib.Parallel(2)(jobs) if r is not None])
    print("| | mean deg | median deg | author's mean deg |\n|---|---|---|---|")
    for column, (name, theirs) in enumerate((("all together", "1.69"), ("each with the first", "1.94"))):
        print(f"| {name} | {rows[:, column].mean():.2f} | {np.median(rows[:, column]):.2f} | {theirs} |")
    print(f"\n{repeats - len(rows)} of {repeats} refused.")


def _panoramic_errors(cameras: Drive, true: Array) -> tuple[float, float] | None:
    try:
        together = _rotations(cameras)
        first, *others = cameras
        apart = np.array([np.eye(3), *(_rotations({n: cameras[n] for n in (first, o)})[1] for o in others)])
    except CalibrationError:
        return None
    return _mean_angle(together, true), _mean_angle(apart, true)


def _rotations(cameras: Drive) -> Array:
    return calibrate_motions(cameras, Config(), clocks=["ladybug"] * len(cameras)).calibration.T_base_sensor[
        :, :3, :3
    ]


def _mean_angle(R: Array, true: Array) -> float:
    """Mean error over every pair of cameras, degrees."""
    x, y = np.triu_indices(len(R), 1)
    apart = np.swapaxes(np.swapaxes(R[x], 1, 2) @ R[y], 1, 2) @ np.swapaxes(true[x], 1, 2) @ true[y]
    return float(np.degrees(np.linalg.norm(se3.log_so3(apart), axis=1)).mean())


def whole(recordings: Path) -> None:
    """All sensors of each whole drive at once, against the truth there is."""
    poses = truth(recordings)
    print("| rig | sensor | rotation deg | roll, pitch, yaw deg | x, y, z m | sigma deg | sigma m | dt ms (sigma) |")
    print("|---|---|---|---|---|---|---|---|")
    kitti = {f"cam{i}": poses[f"velCam{i + 1}"] for i in range(4)}
    for rig, names, true in (
        ("KITTI", ("velo", "cam0", "cam1", "cam2", "cam3"), kitti),
        ("KITTI+INS", ("velo", "ins", "cam0", "cam1", "cam2", "cam3"), {"ins": poses["velNav"], **kitti}),
        ("Shrimp", ("velo", "ins", "cam0", "cam1", "cam2", "cam3", "cam4"), {"ins": poses["shrimp"]}),
    ):
        c = calibrate_motions({n: drive(recordings, rig)[n] for n in names}, Config()).calibration
        for name in names[1:]:
            _whole_row(rig, c, name, true.get(name))
        if "ins" in names and rig == "KITTI+INS":
            T = c.between("ins", "cam0").T_a_b
            for label, there in (
                ("cam0 in ins, against the chain", se3.invert(poses["velNav"]) @ poses["velCam1"]),
                ("cam0 in ins, against `navCam1`", poses["navCam1"]),
            ):
                print(f"| {rig} | {label} | {_errors(T, there)} | | | |")


def _whole_row(rig: str, c: Calibration, name: str, true: Array | None) -> None:
    i = c.index(name)
    errors = _errors(c.T_base_sensor[i], true) if true is not None else "no truth | |"
    s = c.sigma[i]
    dt = f"{1e3 * c.dt_base_sensor[i]:.2f} ({1e3 * s[6]:.2f})"
    print(
        f"| {rig} | {name} | {errors} | {_numbers(np.degrees(s[3:6]), 2)} | {_numbers(s[:3], 3)} | {dt} |", flush=True
    )


def _errors(T: Array, true: Array) -> str:
    turn = true[:3, :3] @ T[:3, :3].T
    angles = np.degrees(Rotation.from_matrix(turn).as_euler("ZYX")[::-1])
    total = np.degrees(np.linalg.norm(se3.log_so3(turn)))
    return f"{total:.2f} | {_numbers(angles, 2)} | {_numbers(T[:3, 3] - true[:3, 3], 2)}"


def cost(recordings: Path) -> None:
    """Time of the calibration stages on the whole stored KITTI drive, as a share of the drive."""
    motions = drive(recordings, "KITTI")
    began = time.perf_counter()
    seconds = calibrate_motions(motions, Config()).statistics["seconds"]
    took = time.perf_counter() - began
    print(
        f"{len(motions)} sensors, {len(motions['velo'])} steps: {took:.1f} s for {seconds:.0f} s of driving,"
        f" {took / seconds:.3f} of the recording"
    )


def _numbers(values: Sequence[float] | Array, digits: int) -> str:
    return ", ".join(f"{v:.{digits}f}" for v in values)


def _rig_with_ins(folder: Path, recordings: Path) -> Path:
    """A rig that puts the drive's INS poses beside the author's motions of the other sensors."""
    stored = recordings / "multi-array-calib" / "kitti"
    tables = [f'[sensors.{n}]\nlog = "{stored}"\nsensor = "{n}"\n' for n in ("velo", "cam0", "cam1", "cam2", "cam3")]
    poses = recordings / "kitti-drive-0027" / "ins_pose_tum.txt"
    tables.append(f'[sensors.ins]\nkind = "odometry"\nposes = "{poses}"\nformat = "tum"\n')
    (folder / "rig.toml").write_text("\n".join(tables))
    return folder


TABLES: dict[str, Callable[[Path], None]] = {
    "timing": timing, "pair": pair, "panoramic": panoramic, "whole": whole, "cost": cost,
}  # fmt: skip

if __name__ == "__main__":
    TABLES[sys.argv[1]](Path(sys.argv[2]).resolve())
