"""A scan as a camera sees it: what the metrics of a lidar and a camera share.

A moment is one scan and one image, or two that follow each other. Points are moved by the lidar's own motion to where
the lidar was when each image was taken (paper, section VII-A); images are freed of distortion.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CostMetric, Pair, Scan, Stream, Transform, poses_at, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.metrics.images import Image, Straightener, grey_images

Array = NDArray[np.float64]
Index = NDArray[np.int64]

CAMERAS = ("monocular", "ladybug")
NEAREST, FARTHEST = 1.5, 80.0
"""Metres: nearer is the vehicle itself, and farther points are few."""
INSTANTS = 48
"""Parts of a sweep that are moved together."""
LATEST = 0.5
"""Seconds between an image and its scan, at most."""
MARGIN = 2.0
"""Sigma of where a point may lie in the image and still be within it."""
LOOKS = 4
"""Rows that are tried to see whether there is an overlap."""
SEEN = 0.1
"""Share of the image that a scan must cover."""
CELLS = (12, 6)
AROUND = 0.2
"""Of the image's size: so far outside it a point may come into view."""
SPARED = 0.35
"""Share of the points that a pose may lose."""
IN_FRONT = 0.5
"""Metres before the camera."""


@dataclass(frozen=True)
class Moment:
    """One scan and the images it is compared with, in pixels of the undistorted camera.

    points: (j, n, 3) metres, lidar frame at each image's instant. facts: what the lidar tells of each, (n, ...).
    grey: (j) of (h, w), as they were taken. straight: frees them of distortion.
    elsewhere: (n, 2) pixels. pictures: what the metric reads at the points, (j) of (c) images.
    """

    points: Array
    facts: dict[str, Array]
    grey: tuple[NDArray[Any], ...]
    straight: Straightener
    elsewhere: NDArray[np.float32]
    pictures: tuple[tuple[Image, ...], ...] = ()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        h, w = self.usable.shape
        return w, h

    @property
    def images(self) -> tuple[Image, ...]:
        """(j) of (h, w), 0 to 1; made anew each time."""
        return tuple(self.straight(image) for image in self.grey)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(h, w) where an image may be used."""
        return self.straight.usable

    @property
    def K(self) -> Array:
        """(3, 3)."""
        return self.straight.K

    def __getitem__(self, keep: Any) -> "Moment":
        facts = {name: values[keep] for name, values in self.facts.items()}
        return replace(self, points=self.points[:, keep], facts=facts, elsewhere=self.elsewhere[keep])

    def pixels(self, T_a_b: Array, j: int = 0) -> NDArray[np.float32]:
        """(k, 2, n) where image j shows the points, for poses (k, 4, 4); nan where it does not."""
        T_b_a = se3.invert(T_a_b)
        K = self.K @ T_b_a[:, :3, :3]
        shift = self.K @ T_b_a[:, :3, 3, None]
        x = (K.astype(np.float32) @ self.points[j].T.astype(np.float32)) + shift.astype(np.float32)
        z = np.where(x[:, 2] > IN_FRONT, x[:, 2], np.float32(np.nan))
        uv = x[:, :2] / z[:, None]
        w, h = self.size
        with np.errstate(invalid="ignore"):
            inside = (uv[:, 0] >= 0) & (uv[:, 0] <= w - 1) & (uv[:, 1] >= 0) & (uv[:, 1] <= h - 1)
        return np.where(inside[:, None], uv, np.float32(np.nan))

    def read(self, T_a_b: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(j, c, k, n) what the pictures of each image show at the points, and how much each point counts, (k, n).

        A few points may leave the view and no longer count. Were it many, a pose could win by comparing less: beyond
        ``SPARED`` of all they read some pixel, always the same, and agree no more than by chance.
        """
        import cv2

        uv = np.array([self.pixels(T_a_b, j) for j in range(len(self.grey))])
        gone = np.isnan(uv).any(axis=(0, 2))
        spared = SPARED * gone.shape[1] / np.maximum(gone.sum(axis=1, keepdims=True), 1)
        weight = np.where(gone, np.maximum(1 - spared, 0.0), 1.0).astype(np.float32)
        uv = np.where(np.isnan(uv), self.elsewhere.T, uv)
        seen = [
            [cv2.remap(p, u, v, cv2.INTER_LINEAR) for p in pictures]
            for pictures, (u, v) in zip(self.pictures, np.ascontiguousarray(np.swapaxes(uv, 1, 2)), strict=True)
        ]
        return np.array(seen), weight


class LidarCamera(CostMetric):
    """What metrics of a lidar and a camera have in common; ``pictures`` and ``costs`` make one of it.

    images: how many that follow each other are compared with one scan.
    """

    images = 1
    points = 4000
    """So many of a moment's are compared, at most."""
    candidates = 12000
    """Of so many those are chosen."""

    def accepts(self, kind_a: str, kind_b: str) -> bool:
        """A lidar, then a camera."""
        return kind_a == "velodyne" and kind_b in CAMERAS

    def cost(self, T_a_b: Array, pair: Moment) -> float:
        """Of one pose (4, 4)."""
        return float(self.costs(T_a_b[None], pair)[0])

    def facts(self, scan: Scan, chosen: Index) -> tuple[NDArray[np.bool_], dict[str, Array]]:
        """Which of the chosen points (m,) of a scan to compare, and what the lidar tells of each, (m, ...)."""
        return np.ones(len(chosen), dtype=bool), {}

    @abstractmethod
    def pictures(self, image: Image, blur: float) -> tuple[Image, ...]:
        """What is looked up at the points; blur: in widths of the finest."""

    def worth(self, moment: Moment, uv: Array, reach: Array) -> NDArray[np.bool_]:
        """Which points (n,) there is something to compare at. uv: (j, 2, n) and reach: (n,) pixels around it."""
        return np.ones(uv.shape[2], dtype=bool)

    def overlap(self, pair: Pair) -> bool:
        """Whether the scan covers a tenth of the image, wherever the camera may be."""
        if not len(pair) or pair.b.intrinsics is None:
            return False
        rows = np.linspace(0, len(pair) - 1, min(len(pair), LOOKS)).astype(int)
        seen = (self.prepare(pair[k : k + 1], self.options()) for k in rows)
        first = next((moment for moment in seen if moment is not None), None)
        return first is not None and covered(first, pair.prior.T_a_b) >= SEEN

    def draw(self, pair: Pair, poses: Mapping[str, Array], folder: Path) -> None:
        """Pictures of the scan on the image, a row for each pose (4, 4), and the cloud coloured by the last of them.

        If rerun is installed, a recording for it, too.
        """
        from importlib.util import find_spec

        from calib_toolkit_plugins.metrics import clouds, pictures

        name, (*_, best) = f"{pair.a.name}-{pair.b.name}", poses.values()
        pictures.overlay(pair, poses, folder)
        clouds.coloured_cloud(pair, best, folder / f"{name}.ply")
        if find_spec("rerun"):
            clouds.recording(pair, best, folder / f"{name}.rrd")

    def prepare(self, pair: Pair, options: Any) -> Moment | None:
        """The scan and image of a row; None where the motion between them is not known."""
        i, first = (int(v) for v in pair.selected[0])
        chosen = range(first, first + self.images)
        if chosen[-1] >= len(pair.b):
            return None
        instants = pair.b.stamps[list(chosen)] + pair.dt_a_b
        if np.any(np.abs(instants - pair.a.stamps[i]) > LATEST):
            return None
        scan = usable_points(pair.a, i)
        rng = np.random.default_rng([i, first])
        grey, straight = grey_images(pair.b, chosen)
        inside = np.argwhere(straight.usable)
        seen = ahead(scan, pair.prior, straight.K, grey[0].shape)
        if not len(inside) or len(seen) < self.points / 20:
            return None
        seen = np.sort(rng.choice(seen, min(self.candidates, len(seen)), replace=False))
        keep, facts = self.facts(scan, seen)
        points = np.array([moved(scan, seen, pair, i, at) for at in instants])
        if not np.all(np.isfinite(points)):
            return None
        elsewhere = inside[rng.integers(len(inside), size=len(seen))][:, ::-1].astype(np.float32)
        return Moment(points, facts, grey, straight, elsewhere)[keep]

    def focus(self, moment: Moment, around: Transform, blur: float) -> Moment | None:
        """The points that the image shows whatever the pose, as far as the covariance tells, and its pictures."""
        made = replace(moment, pictures=tuple(self.pictures(image, blur) for image in moment.images))
        uv = np.concatenate([made.pixels(around.T_a_b[None], j) for j in range(len(made.grey))])
        reach = MARGIN * spread(made, around)
        keep = np.all(np.isfinite(uv), axis=(0, 1)) & within(made.usable, uv, reach)
        made, uv, reach = made[keep], uv[:, :, keep], reach[keep]
        worth = self.worth(made, uv, reach)
        if worth.sum() < self.points / 20:
            return None
        rng = np.random.default_rng(len(worth))
        chosen = np.flatnonzero(worth)
        if len(chosen) > self.points:
            chosen = np.sort(rng.choice(chosen, self.points, replace=False))
        return made[chosen]


def usable_points(stream: Stream, i: int) -> Scan:
    """A scan without what is too near or too far. Raises DataError if a reading is no scan."""
    scan = stream.readings[i]
    points = np.asarray(getattr(scan, "points", None), dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"sensor {stream.name}, reading {i}: a {type(scan).__name__}, where a Scan is needed")
    length = np.linalg.norm(points, axis=1)
    keep = (length > NEAREST) & (length < FARTHEST)
    parts = {name: None if (v := getattr(scan, name)) is None else v[keep] for name in ("times", "intensity", "ring")}
    return Scan(points[keep].astype(np.float32), **parts)


def ahead(scan: Scan, prior: Transform, K: Array, shape: tuple[int, ...]) -> Index:
    """(m,) which points of a scan the image (h, w) may show, roughly."""
    T_b_a = se3.invert(prior.T_a_b)
    x = scan.points @ (K @ T_b_a[:3, :3]).T + K @ T_b_a[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = x[:, :2] / x[:, 2:]
    size = np.array(shape[1::-1])
    inside = np.all((uv > -AROUND * size) & (uv < (1 + AROUND) * size), axis=1)
    return np.flatnonzero(inside & (x[:, 2] > IN_FRONT))


def moved(scan: Scan, chosen: Index, pair: Pair, i: int, at: float) -> Array:
    """(m, 3) chosen points of scan i in the lidar's frame at an instant of its clock; nan where that is not known."""
    points, stamp = scan.points[chosen].astype(np.float64), float(pair.a.stamps[i])
    times = np.zeros(len(points)) if scan.times is None else scan.times[chosen].astype(np.float64)
    edges = np.linspace(times.min(), times.max() + 1e-9, INSTANTS + 1)
    part = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, INSTANTS - 1)
    T = poses_at(pair.motion_a, stamp + (edges[:-1] + edges[1:]) / 2, at)
    return np.einsum("nij,nj->ni", T[part, :3, :3], points) + T[part, :3, 3]


def average(values: NDArray[np.float32], weight: NDArray[np.float32]) -> Array:
    """(k,) of values (k, n), each of its weight."""
    return np.asarray(np.einsum("kn,kn->k", values, weight) / weight.sum(axis=1), np.float64)


def blurred(image: Image, blur: float) -> Image:
    """Smoothed over a 500th of its width (paper, VIII-G) times ``blur``."""
    import cv2

    return np.asarray(cv2.GaussianBlur(image, (0, 0), max(blur * image.shape[1] / 500, 0.3)), np.float32)


def spread(moment: Moment, around: Transform) -> Array:
    """(n,) pixels, one sigma: how far the uncertainty of a pose moves a point in the image."""
    T_b_a = se3.invert(around.T_a_b)
    fx = moment.K[0, 0]
    lever = moment.points[0] - around.T_a_b[:3, 3]
    # seen from the camera a point moves by -dt, and by -delta x lever
    J = np.concatenate([np.broadcast_to(-np.eye(3), (len(lever), 3, 3)), se3.skew(lever)], axis=2)
    ray = lever / np.maximum(np.linalg.norm(lever, axis=1, keepdims=True), 1e-9)
    across = (np.eye(3) - ray[:, :, None] * ray[:, None, :]) @ J
    variance = np.einsum("nij,jk,nik->n", across, around.cov, across) / 2
    depth = np.maximum((moment.points[0] @ T_b_a[2, :3]) + T_b_a[2, 3], IN_FRONT)
    return np.asarray(fx * np.sqrt(variance) / depth)


def within(usable: NDArray[np.bool_], uv: Array, reach: Array) -> NDArray[np.bool_]:
    """Which points (n,) stay in every image and its mask though they move as far as ``reach`` pixels."""
    import cv2

    framed = np.pad(usable.astype(np.uint8), 1)
    room = np.asarray(cv2.distanceTransform(framed, cv2.DIST_L2, 3), np.float32)[1:-1, 1:-1]
    x, y = (np.nan_to_num(uv[:, k]).astype(int) for k in (0, 1))
    return np.all(room[y, x] > reach, axis=0)


def covered(moment: Moment, T_a_b: Array) -> float:
    """Share of the image, by cells, in which the scan has points."""
    uv = moment.pixels(T_a_b[None])[0]
    uv = uv[:, np.isfinite(uv[0])]
    cells = np.floor(uv.T / moment.size * CELLS).astype(int)
    return len(np.unique(cells, axis=0)) / (CELLS[0] * CELLS[1])
