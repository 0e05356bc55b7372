"""Simulated drives beside real ones: ``python docs/results/realism.py RECORDINGS DRIVE``.

RECORDINGS holds kitti-drive-0027/ and kitti360-3000/ (CONTRIBUTING.md); DRIVE is a folder that ``calib-toolkit
simulate DRIVE --rig kitti`` made. Prints Markdown tables; writes realism-motion.png and simulated.png beside itself.
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import fields
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from calib_toolkit import Stream, open_log, se3
from calib_toolkit_datasets.simulation import vehicle
from calib_toolkit_datasets.simulation.lidar import LidarModel
from calib_toolkit_datasets.simulation.rigs import START_NS
from calib_toolkit_datasets.simulation.writing import Wish, build_rig
from calib_toolkit_plugins import deskewing, monocular, registration, velodyne
from calib_toolkit_plugins.epipolar import sampson
from calib_toolkit_plugins.two_view import two_view_motion

mpl.use("Agg")
from matplotlib import pyplot as plt

Array = NDArray[np.float64]
Figures = Mapping[str, float]

SEEDS, STEPS = 10, 45
"""Simulated drives, each as long as the real one; and steps of each sensor."""
AXES = ("roll", "pitch", "yaw")
BANDS = (0.0, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0)
NEAR = 2.0
"""Pixels between a depth edge and an image edge that counts as found."""
OFF = np.radians(1.0)
HALF = 3.0
"""Metres around a wall that are shown from above."""
FLAT, TURNS = 0.1, 30
"""Metres, one sigma, from its line that a wall's points may be; sweeps in bends where one is looked for."""


def driven(recordings: Path) -> tuple[Array, Array]:
    """KITTI's drive 27: speed in m/s every 0.1 s, and roll, pitch and yaw rate in degrees/s every 0.01 s, (n, 3)."""
    folder = recordings / "kitti-drive-0027"
    poses, imu = np.loadtxt(folder / "ins_pose_tum.txt"), np.loadtxt(folder / "imu_gtsam.csv", delimiter=",")
    stamps = np.arange(imu[0, 0], imu[-1, 0], 0.01)
    rates = np.column_stack([np.interp(stamps, imu[:, 0], np.degrees(w)) for w in imu[:, 4:7].T])
    return np.linalg.norm(np.diff(poses[:, 1:4], axis=0), axis=1) / np.diff(poses[:, 0]), rates


def simulated(seconds: float, seed: int) -> tuple[Array, Array]:
    """The same of a simulated street."""
    T = vehicle.path(seconds, seed, "street").at(np.arange(0.0, seconds, 0.01))
    rates = np.degrees(se3.vector(se3.relative(T[:-1], T[1:]))[:, 3:]) / 0.01
    return np.linalg.norm(np.diff(T[::10, :3, 3], axis=0), axis=1) / 0.1, rates


def motion_figures(speed: Array, rates: Array) -> Figures:
    """Percentiles of the speed, and the standard deviation of each rate by frequency."""
    out = {f"speed, percentile {p}, m/s": float(np.percentile(speed, p)) for p in (5, 25, 50, 75, 95)}
    n = len(rates)
    power = 2 * np.abs(np.fft.rfft(rates - rates.mean(axis=0), axis=0) / n) ** 2
    hertz = np.fft.rfftfreq(n, 0.01)
    for axis, own, of_axis in zip(AXES, rates.T, power.T, strict=True):
        out[f"{axis} rate, sd, deg/s"] = float(own.std())
        for low, high in pairwise(BANDS):
            within = (hertz >= low) & (hertz < high)
            out[f"{axis} rate, {low:g} to {high:g} Hz, sd, deg/s"] = float(np.sqrt(of_axis[within].sum()))
    return out


def motion_picture(real: tuple[Array, Array], drives: list[tuple[Array, Array]], file: Path) -> None:
    """Histograms of speed and of the rates at 10 Hz, one over the other."""
    figure, axes = plt.subplots(2, 2, figsize=(9, 6), layout="constrained")
    sets = [("KITTI drive 27", [real], "C0"), (f"simulated, {len(drives)} seeds", drives, "C1")]
    bins = [np.linspace(0, 16, 33), *(np.linspace(-w, w, 49) for w in (6.0, 6.0, 45.0))]
    names = ("speed, m/s", *(f"{axis} rate, degrees/s" for axis in AXES))
    for k, (ax, name, edges) in enumerate(zip(axes.flat, names, bins, strict=True)):
        for label, members, colour in sets:
            values = np.concatenate([m[0] if k == 0 else m[1][::10, k - 1] for m in members])
            share = np.histogram(values, edges)[0] / len(values)
            ax.stairs(share, edges, color=colour, label=label, linewidth=1.5)
        ax.set(xlabel=name, ylabel="share", yscale="log" if k == 3 else "linear")
    axes[0, 1].legend(loc="upper left")
    figure.savefig(file, dpi=100)


def scan_figures(stream: Stream) -> Figures:
    """How well successive sweeps lie on each other at the motion that the plugin finds; medians over the steps."""
    options, stream = velodyne.VelodyneOptions(), stream[: STEPS + 1]
    motions = velodyne.estimate(stream, options)
    rate = motions.vec / (motions.end - motions.start)[:, None]
    middle = (motions.start + motions.end) / 2
    surfaces, points = [], []
    for stamp, scan in zip(stream.stamps, stream.readings, strict=True):
        velocity = np.array([np.interp(stamp, middle, r) for r in rate.T])
        far = np.linalg.norm(scan.points, axis=1)
        used = (far > options.min_range) & (far < options.max_range)
        moved = deskewing.deskew(scan.points[used].astype(float), scan.times[used].astype(float), velocity)
        surfaces.append(registration.surface(moved, options.cell))
        points.append(len(far))
    rows = []
    for k, T in zip(np.searchsorted(stream.stamps, motions.start), se3.matrix(motions.vec), strict=True):
        left = registration.plane_residuals(surfaces[k], surfaces[k + 1].points, T, options.gate)
        rows.append([len(surfaces[k].points), 1e3 * np.median(np.abs(left.errors)), 100 * left.overlap])
    names = ("points after thinning", "distance from the plane, median, mm", "overlap, %")
    return {"points in a sweep": float(np.median(points)), **dict(zip(names, np.median(rows, axis=0), strict=True))}


def image_figures(stream: Stream) -> Figures:
    """What of an image can be followed into the next, as the plugin does it; medians over the steps."""
    options, camera, rows = monocular.MonocularOptions(), stream.intrinsics, []
    assert camera is not None
    views = [monocular._view("", 0.0, image, camera, options) for image in stream.readings[: STEPS + 1]]
    for a, b in pairwise(views):
        p, q = monocular._track(a, b, camera, options)
        prev, curr = (monocular.normalise(x, camera, options.point_sigma)[0] for x in (p, q))
        motion = two_view_motion(prev, curr)
        if motion is None or motion.t is None:
            continue
        agree = motion.inliers
        noise = 1.4826 * np.median(np.abs(sampson(prev[agree], curr[agree], motion.R, motion.t)[0]))
        flow = np.median(np.linalg.norm(q - p, axis=1))
        rows.append([len(a.corners), len(p), agree.sum(), 100 * agree.mean(), flow, noise * options.point_sigma])
    names = ("corners", "tracks kept", "inliers", "inliers, % of tracks", "flow, median, px", "noise of a corner, px")
    return dict(zip(names, np.median(rows, axis=0), strict=True))


class Drive:
    """A simulated drive of the kitti rig, with what is true about it. Times are of the scanner's clock."""

    def __init__(self, folder: Path) -> None:
        held = json.loads((folder / "drive.json").read_text())
        wish = Wish(**{f.name: held[f.name] for f in fields(Wish)})
        self.log = open_log(folder)
        if wish.rig != "kitti" or self.log.reference is None:
            raise SystemExit(f"error: {folder} is no drive of the kitti rig with its truth.json; simulate one")
        self.truth = self.log.reference
        self.velo = build_rig(wish).sensor("velo")
        assert isinstance(self.velo.model, LidarModel)
        self.model = self.velo.model
        self.path = vehicle.path(wish.seconds, wish.seed, wish.drive)

    def poses(self, stamps: Array) -> Array:
        """``T_world_velo`` (n, 4, 4) at stamps of the scanner's clock."""
        ns = np.round(stamps * 1e9).astype(np.int64) + self.log.epoch_ns - START_NS
        return self.path.at(self.velo.instants(ns)) @ self.velo.T_vehicle_sensor

    def sweep(self, k: int) -> tuple[Array, Array]:
        """Points of a sweep in the world, (n, 3): as if all measured at its stamp, and each when it was."""
        scan, stamp = self.log.streams["velo"].readings[k], self.log.streams["velo"].stamps[k]
        points, T = scan.points.astype(float), self.poses(stamp + np.append(scan.times.astype(float), 0.0))
        raw = points @ T[-1, :3, :3].T + T[-1, :3, 3]
        return raw, np.einsum("nij,nj->ni", T[:-1, :3, :3], points) + T[:-1, :3, 3]

    def projected(self, k: int, off: float) -> tuple[Array, Array, NDArray[np.bool_]]:
        """The sweep in image k, the camera turned by ``off`` radians about its y axis.

        Pixels (m, 2), depths (m,), and which points have something farther right beside them in their ring.
        """
        camera, T_velo_cam = self.log.streams["cam0"], self.truth.between("velo", "cam0").T_a_b
        base = camera.stamps[k] + self.truth.dt_at("velo", "cam0", camera.stamps[k])
        nearest = int(np.argmin(np.abs(self.log.streams["velo"].stamps - base)))
        T = se3.invert(self.poses(np.array([base])) @ T_velo_cam @ se3.matrix([0, 0, 0, 0, off, 0]))[0]
        seen, zero = self.sweep(nearest)[1] @ T[:3, :3].T + T[:3, 3], np.zeros(3)
        lens = camera.intrinsics
        assert lens is not None
        assert lens.size is not None
        width, height = lens.size
        rim = np.array([[x, y] for x in (0, width / 2, width) for y in (0, height / 2, height)])
        corners = cv2.undistortPoints(rim[:, None], lens.K, lens.distortion)[:, 0]
        flat = seen[:, :2] / seen[:, 2:]
        ahead = (seen[:, 2] > 1) & np.all((flat > corners.min(axis=0)) & (flat < corners.max(axis=0)), axis=1)
        spots = cv2.projectPoints(seen[ahead], zero, zero, lens.K, lens.distortion)[0]
        px = np.asarray(spots, dtype=np.float64).reshape(-1, 2)
        kept = np.all((px >= 0) & (px < [width - 1, height - 1]), axis=1)
        return px[kept], seen[ahead, 2][kept], self._edges(nearest)[ahead][kept]

    def _edges(self, k: int) -> NDArray[np.bool_]:
        points, model = self.log.streams["velo"].readings[k].points.astype(float), self.model
        away = np.linalg.norm(points, axis=1)
        ring = np.abs(np.arcsin(points[:, 2] / away)[:, None] - np.array(model.elevations)).argmin(axis=1)
        turn = 0.5 - np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
        column = np.floor(turn * model.columns).astype(int) % model.columns
        table = np.zeros((len(model.elevations), model.columns))
        table[ring, column] = away
        beside = np.max([table[ring, (column + d) % model.columns] for d in (-1, 1)], axis=0)
        return beside > np.maximum(away + 0.5, 1.1 * away)


def edge_figures(drive: Drive, frames: range) -> Figures:
    """How many of the sweeps' depth edges lie on edges of the images; all points for comparison; in per cent."""
    rows = []
    for k in frames:
        smooth = cv2.GaussianBlur(drive.log.streams["cam0"].readings[k], (0, 0), 1.0)
        away = cv2.distanceTransform(255 - cv2.Canny(smooth, 25, 60), cv2.DIST_L2, 5)
        views = [drive.projected(k, off) for off in (0.0, OFF)]
        near = [away[tuple(np.rint(px).astype(int).T[::-1])] <= NEAR for px, _, _ in views]
        rows.append([near[0][views[0][2]].mean(), near[1][views[1][2]].mean(), near[0].mean()])
    names = ("true calibration", "off by 1 degree", "points anywhere, true calibration")
    return dict(zip(names, 100 * np.mean(rows, axis=0), strict=True))


def picture(drive: Drive, k: int, file: Path) -> None:
    """Image k, the sweep in its busiest part (true calibration, and 1 degree off), two sweeps from above."""
    names = ["raw", "deskewed with the true trajectory"]
    views = {"the sweep, true calibration": 0.0, "the sweep, the camera turned by 1 degree": OFF}
    places: Any = [["image"] * 2, *([view] * 2 for view in views), names]
    figure, axes = plt.subplot_mosaic(places, figsize=(8, 11.5), height_ratios=[1, 1, 1, 1.7], layout="constrained")
    image = cv2.medianBlur(drive.log.streams["cam0"].readings[k], 3)  # without noise the file is half as large
    size = np.array(image.shape[::-1])
    for name in ("image", *views):
        axes[name].imshow(image, "gray", vmin=0, vmax=255)
        axes[name].set(xticks=[], yticks=[], title=name)
    px, _, edges = drive.projected(k, 0.0)
    low = np.clip(np.median(px[edges], axis=0) - size / 4, 0, size / 2)
    for name, off in views.items():
        px, depth, _ = drive.projected(k, off)
        axes[name].images[0].set_clim(0, 400)  # dark, so that the points are seen
        axes[name].scatter(px[:, 0], px[:, 1], 4, np.log(depth), cmap="turbo", vmin=1.8, vmax=3.6, linewidths=0)
        axes[name].set(xlim=(low[0], low[0] + size[0] / 2), ylim=(low[1] + size[1] / 2, low[1]))
    sweep, centre = wall(drive)
    for way, name in enumerate(names):
        for i, colour in ((sweep, "C0"), (sweep + 1, "C3")):
            at = _from_above(drive, i)[way] - centre
            axes[name].scatter(at[:, 0], at[:, 1], 4, color=colour, label=f"sweep {i}", linewidths=0)
        axes[name].set(xlim=(-HALF, HALF), ylim=(-HALF, HALF), aspect="equal", xlabel="m", title=name)
        axes[name].legend(loc="upper right")
    buffer = BytesIO()
    figure.savefig(buffer, dpi=100)
    Image.open(buffer).convert("RGB").quantize(200, dither=Image.Dither.NONE).save(file, optimize=True)


def wall(drive: Drive) -> tuple[int, Array]:
    """The sweep and the centre (2,) of the wall that deskewing mends most, among sweeps where the vehicle turns."""
    T = drive.poses(drive.log.streams["velo"].stamps)
    turned = np.linalg.norm(se3.log_so3(se3.relative(T[:-1], T[1:])[:, :3, :3]), axis=1)
    best: tuple[float, int, Array] = (-np.inf, 0, np.zeros(2))
    for k in np.argsort(turned)[-TURNS:].tolist():
        raw, deskewed = (np.concatenate(x) for x in zip(*(_from_above(drive, i) for i in (k, k + 1)), strict=True))
        cells = np.floor(deskewed / (2 * HALF))
        for cell in np.unique(cells, axis=0):
            inside = np.all(cells == cell, axis=1)
            if inside.sum() > 400:
                bent, flat = (np.sqrt(np.linalg.eigvalsh(np.cov(x[inside].T))[0]) for x in (raw, deskewed))
                if flat < FLAT:
                    best = max(best, (bent - flat, k, deskewed[inside].mean(axis=0)), key=lambda found: found[0])
    return best[1:]


def _from_above(drive: Drive, k: int) -> tuple[Array, Array]:
    """x and y of a sweep's points, raw and deskewed, from 1.3 m below the scanner to 1.5 m above, within 30 m."""
    raw, deskewed = drive.sweep(k)
    away = deskewed - drive.poses(drive.log.streams["velo"].stamps[k : k + 1])[0, :3, 3]
    near = (away[:, 2] > -1.3) & (away[:, 2] < 1.5) & (np.linalg.norm(away, axis=1) < 30.0)
    return raw[near, :2], deskewed[near, :2]


def table(title: str, columns: Mapping[str, Figures]) -> None:
    """Print figures of several things side by side."""
    print(f"\n| {' | '.join([title, *columns])} |\n{'|---' * (1 + len(columns))}|")
    for name in next(iter(columns.values())):
        print(f"| {name} | {' | '.join(f'{_number(column[name])}' for column in columns.values())} |")


def _number(x: float) -> str:
    return f"{x:.0f}" if x >= 100 else f"{x:.3g}"


def main(recordings: Path, folder: Path, out: Path) -> None:
    """All tables and pictures."""
    real = driven(recordings)
    drives = [simulated(len(real[1]) * 0.01, seed) for seed in range(1, SEEDS + 1)]
    rows = [motion_figures(*drive) for drive in drives]
    spread = {name: [row[name] for row in rows] for name in rows[0]}
    simulations = {
        f"{what} of {SEEDS} simulated": {n: float(f(v)) for n, v in spread.items()}
        for what, f in (("median", np.median), ("least", np.min), ("most", np.max))
    }
    table("motion", {"KITTI drive 27": motion_figures(*real), **simulations})
    motion_picture(real, drives, out / "realism-motion.png")
    drive, beside = Drive(folder), open_log(recordings / "kitti360-3000").streams
    logs = {"KITTI-360": beside, "simulated": drive.log.streams}
    table("successive sweeps", {name: scan_figures(streams["velo"]) for name, streams in logs.items()})
    table("successive images", {name: image_figures(streams["cam0"]) for name, streams in logs.items()})
    frames = range(2, len(drive.log.streams["cam0"]) - 2, 7)
    table("% of depth edges within 2 px of an image edge", {"simulated": edge_figures(drive, frames)})
    picture(drive, max(frames, key=lambda k: drive.projected(k, 0.0)[2].sum()), out / "simulated.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path(__file__).parent)
