"""How fast appearance metrics are: ``OMP_NUM_THREADS=1 python docs/results/metrics.py RECORDING LIDAR,CAMERA``.

Prints, as Markdown, evaluations of 25 moments a second beside a plain NumPy gather of as many pixels in the same run,
and how long a whole search takes.
"""

import sys
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Config, CostMetric, Pair, Transform, open_log, se3
from calib_toolkit.appearance.pairs import select
from calib_toolkit.appearance.search import estimate
from calib_toolkit.cache import default_folder
from calib_toolkit.pipeline import sensor_motions
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Silent

Array = NDArray[np.float64]

MOMENTS, POSES, ROUNDS = 25, 12, 5
SIGMA = np.array([0.15] * 3 + [np.radians(1.5)] * 3)


def main(recording: str, sensors: str) -> None:
    """A row for each metric that the core searches."""
    a, b = sensors.split(",")
    log = open_log(recording).select([a, b])
    if log.reference is None:
        raise SystemExit(f"{recording} has no reference to look from")
    T = log.reference.between(a, b).T_a_b
    moved = sensor_motions(log, Config(), registry(), Silent(), default_folder())
    streams, motion = log.streams, {n: moved[n].motion for n in (a, b)}
    rows = select(streams[a], streams[b], motion[a], 0.0, MOMENTS, 0)
    pair = Pair(streams[a], streams[b], motion[a], motion[b], 0.0, rows, Transform(a, b, T, np.diag(SIGMA**2)))
    step = np.random.default_rng(0).normal(size=(POSES, 6)) * SIGMA / 10
    poses = se3.rigid(se3.exp_so3(step[:, 3:]) @ T[:3, :3], T[:3, 3] + step[:, :3])
    print("| metric | moments | points | evaluations a second | gathers a second | evaluation / gather | search s |")
    print("|---|---|---|---|---|---|---|")
    for metric in registry().metrics.values():
        if not isinstance(metric, CostMetric) or not metric.accepts(streams[a].kind, streams[b].kind):
            continue
        ready = [metric.prepare(pair[k : k + 1], metric.options()) for k in range(len(pair))]
        near = Transform(a, b, T, np.diag((SIGMA / 4) ** 2))
        moments = [m for m in (metric.focus(m, near, 0.5) for m in ready if m is not None) if m is not None]
        points = sum(m.points.size // 3 for m in moments)
        took = seconds(lambda metric=metric, moments=moments: [metric.costs(poses, m) for m in moments]) / POSES
        plain = gather(points)
        start = time.process_time()
        estimate(metric, pair, metric.options(), 0)
        whole = time.process_time() - start
        print(
            f"| {metric.id} | {len(moments)} | {points} | {1 / took:.1f} | {1 / plain:.1f} | {took / plain:.1f} "
            f"| {whole:.1f} |",
            flush=True,
        )


def gather(points: int) -> float:
    """Seconds to look up as many pixels of an image, one for each point."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (376, 1408), dtype=np.uint8)
    v, u = rng.integers(0, 376, (POSES, points)), rng.integers(0, 1408, (POSES, points))
    return seconds(lambda: image[v, u]) / POSES


def seconds(work: Callable[[], object]) -> float:
    """Of processor time, the least of some."""
    took = []
    for _ in range(ROUNDS):
        start = time.process_time()
        work()
        took.append(time.process_time() - start)
    return min(took)


if __name__ == "__main__":
    main(*sys.argv[1:3])
