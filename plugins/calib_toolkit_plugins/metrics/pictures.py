"""What a person judges a pose by: scans drawn on images, before and after."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from calib_toolkit import Pair, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.metrics.images import grey_images
from calib_toolkit_plugins.metrics.points import steps_behind
from calib_toolkit_plugins.metrics.views import LATEST, Array, Index, Moment, ahead, moved, usable_points

Part = tuple[int, int, int, int]  # left, top, width and height, pixels

MOMENTS, CANDIDATES, FEWEST = 3, 4, 100  # pictures of a pair, readings looked at for each, points that one must have
STEP = (0.5, 0.05)  # how much farther what is beside an edge lies, at least: metres, share of its distance
BESIDE, HIDING = 9, 1.2  # of so many nearest in the image, a point hides what is so many times farther

WIDTH, GAP, STRIP, TALLEST = 1600, 12, 34, 520
"""Pixels: of a picture, between panels, of a line of text, of a panel."""
CROP, CROP_SHAPE, FAR_SHIFT = 0.25, 0.42, 30.0
"""What is enlarged: width in widths of the image, height in its own; pixels beyond which a shift tells no more."""
BRIGHT = 1.3  # brighter than the image gets: the white of its scale, so that points stand out
TICKS = (4, 6, 10, 20, 40)  # metres, on the scale of colours
GUIDE = "The right pose lays each outline of the scan on that of the same thing in the image, or a beam inside it."


def overlay(pair: Pair, poses: Mapping[str, Array], folder: Path) -> list[Path]:
    """Write ``A-B-K.png``: a lidar's points on a camera's image, for two or three moments spread over the drive.

    pair: a lidar (a) and a camera (b). poses: ``T_a_b`` (4, 4) by what to call it, the one to compare with first.
    Each has a row: left the outlines of what the lidar sees, right its intensity; below, where they differ most.
    Raises DataError if no scan and image of ``pair.selected`` can be laid over each other.
    """
    if not poses:
        raise DataError(f"sensors {pair.a.name} and {pair.b.name}: no pose was given to draw; name at least one")
    moments = telling_moments(pair)
    if not moments:
        raise nothing_to_draw(pair)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for k, (row, moment) in enumerate(moments):
        files.append(folder / f"{pair.a.name}-{pair.b.name}-{k}.png")
        stamp = pair.b.stamps[pair.selected[row, 1]]
        draw(moment, poses, f"{pair.a.name} on {pair.b.name} at {stamp:.1f} s{differences(poses)}", files[-1])
    return files


def laid(pair: Pair, row: int) -> Moment | None:
    """The scan and image of a row of ``pair.selected``, with every point that the image may show.

    facts: "edge" (n,) and, if the lidar tells, "intensity" (n,). None if they were not taken together, or the lidar's
    motion between them is not known.
    """
    i, k = (int(v) for v in pair.selected[row])
    at = float(pair.b.stamps[k] + pair.dt_a_b)
    if abs(at - pair.a.stamps[i]) > LATEST:
        return None
    scan = usable_points(pair.a, i)
    grey, straight = grey_images(pair.b, [k])
    near = ahead(scan, pair.prior, straight.K, grey[0].shape)
    if len(near) < FEWEST:
        return None
    points = moved(scan, near, pair, i, at)
    around, all_of_them = scan.points[near], np.arange(len(near))
    # turned about the line of sight, what is above lies beside
    quarter = se3.exp_so3(np.pi / 2 * pair.prior.T_a_b[:3, 2]).astype(np.float32)
    step = np.maximum(*(steps_behind(p, all_of_them) for p in (around, around @ quarter.T)))
    facts: dict[str, Array] = {"edge": step / np.maximum(STEP[0], STEP[1] * np.linalg.norm(around, axis=1))}
    if scan.intensity is not None:
        facts["intensity"] = scan.intensity[near].astype(np.float64)
    known = np.all(np.isfinite(points), axis=1)
    found = Moment(points[None], facts, grey, straight, np.zeros((len(points), 2), np.float32))[known]
    return found if known.any() else None


def visible(moment: Moment, T_a_b: Array) -> tuple[Array, Index]:
    """(m, 2) pixels, and which (m,) of a moment's points the image shows there, where nothing nearer hides them."""
    uv = moment.pixels(T_a_b[None])[0].T.astype(np.float64)
    shown = np.flatnonzero(np.isfinite(uv[:, 0]))
    x, y = np.round(uv[shown]).astype(int).T
    shown = shown[moment.usable[y, x]]
    depth = np.linalg.norm(moment.points[0][shown] - T_a_b[:3, 3], axis=1)
    if len(shown) > BESIDE:
        beside = cKDTree(uv[shown]).query(uv[shown], k=BESIDE)[1]
        shown = shown[depth < HIDING * depth[beside].min(axis=1)]
    return uv[shown], shown


def visible_edges(moment: Moment, T_a_b: Array) -> tuple[Array, Index]:
    """(m, 2) pixels, and which (m,) of a moment's points are edges that the image shows there."""
    uv, shown = visible(moment, T_a_b)
    keep = moment.facts["edge"][shown] > 1
    return uv[keep], shown[keep]


def telling_moments(pair: Pair) -> list[tuple[int, Moment]]:
    """Rows of ``pair.selected`` spread over the drive, each the best of a few: with many edges, and near ones."""

    def worth(candidate: tuple[int, Moment]) -> float:
        near = candidate[1].points[0][visible_edges(candidate[1], pair.prior.T_a_b)[1]]
        return float(np.sum(1 / np.linalg.norm(near, axis=1)))

    found = []
    for part in np.array_split(np.arange(len(pair)), MOMENTS):
        few = part[:: max(-(-len(part) // CANDIDATES), 1)]
        candidates = [(int(row), moment) for row in few if (moment := laid(pair, row)) is not None]
        found += [max(candidates, key=worth)] if candidates else []
    return found


def telling_part(moment: Moment, T_one: Array, T_other: Array | None = None) -> Part:
    """Where edges are dense and two poses draw them far apart."""
    import cv2

    w, h = moment.size
    width = int(CROP * w)
    height = min(int(CROP_SHAPE * width), h)
    uv, shown = visible_edges(moment, T_one if T_other is None else T_other)
    apart = np.linalg.norm(moment.pixels(T_one[None])[0].T[shown] - uv, axis=1)
    heat = np.zeros((h, w), np.float32)
    x, y = np.round(uv).astype(int).T
    np.add.at(heat, (y, x), 0.1 + np.minimum(np.nan_to_num(apart, nan=FAR_SHIFT), FAR_SHIFT))
    total = cv2.boxFilter(heat, -1, (width, height), anchor=(0, 0), normalize=False, borderType=cv2.BORDER_CONSTANT)
    top, left = np.unravel_index(np.argmax(total[: h - height + 1, : w - width + 1]), (h - height + 1, w - width + 1))
    return int(left), int(top), width, height


def differences(poses: Mapping[str, Array]) -> str:
    """How far each pose is from the first, in words."""
    (name, first), *others = poses.items()
    known = [(other, T) for other, T in others if np.all(np.isfinite(T - first))]
    far = [100 * np.linalg.norm((T - first)[:3, 3]) for _, T in known]
    turned = [np.degrees(np.linalg.norm(se3.log_so3(T[:3, :3] @ first[:3, :3].T))) for _, T in known]
    said = zip(known, far, turned, strict=True)
    return "".join(f"; {other} is {cm:.1f} cm and {degrees:.2f}° from {name}" for (other, _), cm, degrees in said)


def draw(moment: Moment, poses: Mapping[str, Array], title: str, file: Path) -> None:
    """One picture of a moment: a row for each pose, what is enlarged side by side, the scales of colour."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    w, h = moment.size
    whole, part = (0, 0, w, h), telling_part(moment, *list(poses.values())[:: max(len(poses) - 1, 1)])
    wide = min((WIDTH - GAP) / 2, TALLEST * w / h)
    tall = wide * h / w
    close = (WIDTH - GAP * (len(poses) - 1)) / max(len(poses), 2)
    below = 1.5 * STRIP + (STRIP + tall) * len(poses) + STRIP
    height = below + close * part[3] / part[2] + 2 * STRIP
    figure = Figure(figsize=(WIDTH / 100, height / 100), dpi=100)

    def panel(x: float, y: float, wide: float, tall: float, words: str) -> Any:
        figure.text((x + 4) / WIDTH, 1 - (y - 7) / height, words, size=13, va="bottom")
        return figure.add_axes((x / WIDTH, 1 - (y + tall) / height, wide / WIDTH, tall / height))

    figure.text(0.5, 1 - STRIP / 2 / height, title, ha="center", va="center", size=15, weight="bold")
    figure.text(0.5, 1 - 1.2 * STRIP / height, GUIDE, ha="center", va="center", size=13)
    columns = (WIDTH - GAP) / 2 - wide, (WIDTH + GAP) / 2
    shade = "intensity" if "intensity" in moment.facts else "distance, m"
    for k, (name, T) in enumerate(poses.items()):
        y = 2.5 * STRIP + (STRIP + tall) * k
        outlines = visible_edges(moment, T)
        at = panel(columns[0], y, wide, tall, f"{name}: outlines in the scan")
        distance = on_image(at, moment, *outlines, whole, "distance, m", 5)
        at.add_patch(Rectangle(part[:2], *part[2:], fill=False, color="white", linewidth=1.2))
        at = panel(columns[1], y, wide, tall, f"{name}: {shade.split(',')[0]} of every point")
        shaded = on_image(at, moment, *visible(moment, T), whole, shade, 2)
        size = close, close * part[3] / part[2]
        at = panel((close + GAP) * k, below, *size, f"{name}, enlarged {close / part[2]:.1f} times")
        on_image(at, moment, *outlines, part, "distance, m", 20)
    for x, drawn, words in zip(columns, (distance, shaded), ("distance, m", shade), strict=True):
        bar = figure.add_axes(((x + 0.2 * wide) / WIDTH, STRIP / height, 0.6 * wide / WIDTH, 10 / height))
        ticks = TICKS if words == "distance, m" else None
        figure.colorbar(drawn, cax=bar, orientation="horizontal", ticks=ticks, format="%g").minorticks_off()
        figure.text((x + 0.19 * wide) / WIDTH, (STRIP + 5) / height, words, ha="right", va="center", size=12)
    figure.savefig(file)


def on_image(axes: Any, moment: Moment, uv: Array, shown: Index, part: Part, fact: str, size: float) -> Any:
    """Points over a part of the grey image, coloured by what is known of them."""
    import cv2
    from matplotlib.colors import LogNorm, Normalize

    left, top, across, down = part
    even = cv2.createCLAHE(clipLimit=4.0, tileGridSize=(8, 4))  # brings out what is in the shade
    grey = np.asarray(even.apply(np.round(255 * np.clip(moment.images[0], 0, 1)).astype(np.uint8)))
    low, high = np.percentile(grey[top : top + down, left : left + across], [1, 99])
    axes.imshow(grey, cmap="gray", vmin=low, vmax=low + BRIGHT * (high - low + 1), interpolation="bilinear")
    if fact in moment.facts:
        values, colours = moment.facts[fact], "viridis"
        norm = Normalize(*np.percentile(values, [5, 95]))
    else:
        values, colours = np.linalg.norm(moment.points[0], axis=1), "rainbow_r"
        norm = LogNorm(TICKS[0], TICKS[-1])
    dots = axes.scatter(*uv.T, c=values[shown], s=size, norm=norm, cmap=colours, linewidths=0)
    axes.set(xlim=(left - 0.5, left + across - 0.5), ylim=(top + down - 0.5, top - 0.5), xticks=[], yticks=[])
    return dots


def nothing_to_draw(pair: Pair) -> DataError:
    """The refusal."""
    a, b = pair.a.name, pair.b.name
    return DataError(
        f"sensors {a} and {b}: none of {len(pair)} selected readings can be drawn; scan and image must be within "
        f"{LATEST:g} s, see the same place, and the motion of {a} in between be known; check the clocks and the pose"
    )
