"""What stands beside roads and moves on them. Every mesh has its ground at z = 0 and, if it is long, lies along x."""

import numpy as np
from numpy.typing import NDArray

from calib_toolkit_datasets.simulation.shapes import (
    MATERIAL,
    Mesh,
    blob,
    box,
    fan,
    leaves,
    loft,
    merge,
    place,
    quads,
    tube,
)

CARS = ("hatchback", "saloon", "van", "lorry")
_PROFILES = {
    # x, top, narrowing at the top; from the rear to the front, for a belt line at the third number
    "hatchback": (
        [-1.98, -1.9, -1.62, -0.2, 0.45, 1.15, 1.8, 1.95],
        [0.75, 0.98, 1.43, 1.48, 1.44, 0.97, 0.82, 0.62],
    ),
    "saloon": ([-2.3, -2.2, -1.75, -1.15, 0.3, 1.1, 2.1, 2.25], [0.7, 0.96, 1.02, 1.42, 1.43, 0.95, 0.8, 0.58]),
    "van": ([-2.45, -2.42, -2.35, 0.3, 1.25, 1.9, 2.4, 2.5], [0.9, 1.9, 2.0, 2.05, 1.95, 1.15, 0.95, 0.65]),
    "lorry": ([-4.0, -3.98, -3.96, 1.9, 1.92, 3.4, 3.5, 3.6], [3.3, 3.35, 3.4, 3.4, 2.7, 2.65, 1.5, 0.7]),
}
_LENGTHS = {"hatchback": (-1.25, 1.25), "saloon": (-1.4, 1.4), "van": (-1.5, 1.55), "lorry": (-2.6, 2.6)}


def car(kind: str) -> Mesh:
    """A car of one of ``CARS``, front towards x; 1.75 to 2.4 m wide."""
    x, top = (np.array(v) for v in _PROFILES[kind])
    half, wheel = (1.2, 0.45) if kind == "lorry" else (0.95, 0.33) if kind == "van" else (0.87, 0.31)
    belt = np.minimum(top, 1.3 if kind in ("van", "lorry") else 0.93)
    nose = half * np.array([0.9, 0.97, 1, 1, 1, 0.98, 0.93, 0.84])
    roof = nose * (1 - (0.03 if kind == "lorry" else 0.2) * np.clip((top - belt) / 0.5, 0.05, 1.0))
    low, mid = np.full(8, 0.28 if half < 1 else 0.5), np.minimum(0.6, belt)
    side = [(-nose, low), (-nose * 1.01, mid), (-nose, belt), (-roof, top)]
    outline = side + [(-y, z) for y, z in side[::-1]]
    rings = np.stack([np.column_stack([x, y, z]) for y, z in outline], axis=1)
    made_of = np.full((7, 8), MATERIAL["paint"], dtype=np.uint8)
    made_of[:, 7] = MATERIAL["rubber"]
    cab = slice(4, 5) if kind == "lorry" else slice(3, 5) if kind == "van" else slice(1, 5)
    made_of[cab, 2] = made_of[cab, 4] = MATERIAL["glass"]
    # between roof and bonnet or boot lid the top is a windscreen
    steep = np.abs(np.diff(top)) / np.diff(x) > 0.4
    front = x[:-1] > (0 if kind in ("van", "lorry") else -9)
    made_of[steep & front & (np.maximum(top[:-1], top[1:]) > 1.2), 3] = MATERIAL["glass"]
    wheels = [_wheel(at, y, wheel) for at in _LENGTHS[kind] for y in (-half, half)]
    return merge([loft(rings, made_of), *wheels, _lights(x[0] - 0.01, half), _lights(x[-1] + 0.01, half)])


def pedestrian(rng: np.random.Generator) -> Mesh:
    """Somebody who walks towards x."""
    stride, tall = rng.uniform(0.15, 0.35), rng.uniform(0.92, 1.08)
    legs = [tube([[s, y, 0], [s * 0.6, y, 0.45], [0, y, 0.9]], [0.06, 0.07, 0.09], "cloth") for s, y in _feet(stride)]
    arms = [
        tube([[0, 1.7 * y, 1.4], [-0.8 * s, 2.2 * y, 0.85]], [0.055, 0.045], "cloth", 5) for s, y in _feet(stride)
    ]
    torso = tube([[0, 0, 0.85], [0, 0, 1.1], [0, 0, 1.42], [0, 0, 1.5]], [0.16, 0.15, 0.2, 0.08], "cloth", 8)
    head = blob([0.02, 0, 1.64], [0.1, 0.085, 0.12], "earth", rng, 0.03)
    return place(merge([*legs, *arms, torso, head]), [0, 0, 0, 0], 0, [tall, tall, tall])


def tree(height: float, spread: float, rng: np.random.Generator) -> Mesh:
    """A broad-leaved tree: a forked trunk under a crown of uneven clumps with loose tufts round them."""
    bare = 0.38 * height
    bend = rng.normal(0, 0.12, 2)
    fork = np.array([*bend, bare])
    parts = [tube(np.stack([[0, 0, -0.5], 0.5 * fork, fork]), [0.2, 0.15, 0.13], "bark")]
    turn = rng.uniform(0, 2 * np.pi)
    for k in range(3):
        out = np.array([np.cos(turn + k * 2.1), np.sin(turn + k * 2.1), 0.0]) * spread * rng.uniform(0.25, 0.45)
        clump = fork + out + [0, 0, (height - bare) * rng.uniform(0.2, 0.6)]
        radii = spread * rng.uniform(0.5, 0.68, 3) * [1, 1, 0.8]
        parts += [
            tube([fork, clump], [0.1, 0.04], "bark", 5),
            blob(clump, 0.85 * radii, "leaves", rng, 0.2),
            leaves(clump, radii, 36, 0.55, rng),
        ]
    return merge(parts)


def conifer(height: float, rng: np.random.Generator) -> Mesh:
    """A fir: a thin trunk and tiers of branches."""
    parts = [tube([[0, 0, -0.5], [0, 0, height]], [0.16, 0.03], "bark")]
    for low in np.linspace(0.12, 0.82, 5) * height:
        wide = 0.24 * (height - low) + 0.2
        turn = np.linspace(0, 2 * np.pi, 10, endpoint=False)
        radius = wide * rng.uniform(0.6, 1.1, 10)
        skirt = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), low + rng.uniform(-0.2, 0.2, 10)])
        tip = np.array([0.0, 0.0, low + 0.28 * height])
        parts.append(loft([skirt, tip + 0.05 * (skirt - skirt.mean(axis=0))], "leaves"))
    return merge(parts)


def grove(rng: np.random.Generator) -> Mesh:
    """A clump of trees seen from far, about 14 m long and 8 m high."""
    x = np.linspace(-5.0, 5.0, 4) + rng.uniform(-1, 1, 4)
    tall = rng.uniform(2.5, 4.5, 4)
    crowns = [
        blob([a, b, 1.3 * h], [3.0, 3.0, h], "leaves", rng, 0.25, 4)
        for a, b, h in zip(x, x[::-1] / 3, tall, strict=True)
    ]
    trunks = [tube([[a, b, -3], [a, b, 3]], [0.3, 0.2], "bark", 4) for a, b in zip(x, x[::-1] / 3, strict=True)]
    return merge([*crowns, *trunks])


def bush(rng: np.random.Generator) -> Mesh:
    """A bush about 1.4 m across."""
    return merge(
        [
            blob([0, 0, 0.45], [0.65, 0.6, 0.6], "leaves", rng, 0.25, 4),
            leaves([0, 0, 0.5], [0.7, 0.65, 0.65], 14, 0.3, rng),
        ]
    )


def hedge(rng: np.random.Generator, length: float = 2.5, height: float = 1.3) -> Mesh:
    """A piece of clipped hedge, its surface uneven by some centimetres."""
    x = np.linspace(-length / 2, length / 2, 6)
    outline = np.array([[-0.35, -0.3], [-0.38, 0.6 * height], [-0.3, height], [0.3, height], [0.38, 0.6 * height]])
    outline = np.concatenate([outline, [[0.35, -0.3]]])
    rings = np.empty((6, 6, 3))
    rings[..., 0], rings[..., 1:] = x[:, None], outline + rng.normal(0, 0.04, (6, 6, 2))
    return loft(rings, "leaves")


def fence(length: float = 2.5) -> Mesh:
    """A piece of wooden fence: posts, rails and upright boards with gaps."""
    boards = [box([x, -0.01, 0.08], [x + 0.09, 0.01, 1.1], "wood") for x in np.arange(-length / 2, length / 2, 0.21)]
    rails = [box([-length / 2, 0.01, z], [length / 2, 0.05, z + 0.08], "wood") for z in (0.3, 0.85)]
    return merge([*boards, *rails, box([-length / 2, 0.0, -0.5], [-length / 2 + 0.1, 0.1, 1.15], "wood")])


def garden_wall(length: float = 2.5) -> Mesh:
    """A piece of low brick wall with a coping and a pier."""
    w = length / 2
    pier = box([-w, -0.2, -0.5], [-w + 0.4, 0.2, 1.25], "brick")
    return merge(
        [
            box([-w, -0.12, -0.5], [w, 0.12, 0.8], "brick"),
            box([-w, -0.16, 0.8], [w, 0.16, 0.87], "concrete"),
            pier,
        ]
    )


def lamp() -> Mesh:
    """A street lamp, its arm towards y."""
    post = tube([[0, 0, -0.3], [0, 0, 1.0], [0, 0, 5.6], [0, 0.35, 6.1], [0, 1.2, 6.25]], _LAMP, "metal", 8)
    return merge([post, box([-0.12, 1.1, 6.17], [0.12, 1.75, 6.27], "glass")])


_LAMP = [0.1, 0.08, 0.06, 0.05, 0.04]


def sign(shape: str) -> Mesh:
    """A traffic sign on a post, its face towards -x. shape: round, square or triangle."""
    post = tube([[0, 0, -0.3], [0, 0, 2.75]], [0.035, 0.035], "metal")
    n = {"round": 12, "square": 4, "triangle": 3}[shape]
    turn = np.linspace(0, 2 * np.pi, n, endpoint=False) + {3: np.pi / 2, 4: np.pi / 4}.get(n, 0.0)
    face = np.column_stack([np.zeros(n), 0.34 * np.cos(turn), 2.4 + 0.34 * np.sin(turn)])
    plate = loft([face - [0.06, 0, 0], face - [0.045, 0, 0]], "sign")
    back = loft([face - [0.044, 0, 0], face - [0.04, 0, 0]], "metal")
    return merge([post, plate, back])


def bollard() -> Mesh:
    """A marker post of a country road, with its reflector."""
    post = box([-0.06, -0.06, -0.3], [0.06, 0.06, 1.0], "paint")
    return merge([post, box([-0.065, -0.065, 0.7], [0.065, 0.065, 0.9], "sign")])


def board() -> Mesh:
    """A large direction sign on two posts, its face towards -x."""
    posts = [tube([[0, y, -0.3], [0, y, 4.2]], [0.06, 0.06], "metal") for y in (-0.9, 0.9)]
    return merge([*posts, box([-0.15, -1.6, 2.2], [-0.1, 1.6, 4.4], "sign")])


def cable_pole() -> Mesh:
    """A wooden pole with a cross-arm."""
    pole = tube([[0, 0, -0.5], [0, 0, 8.5]], [0.15, 0.1], "wood", 8)
    return merge([pole, box([-0.06, -0.9, 7.9], [0.06, 0.9, 8.02], "wood")])


def bin_() -> Mesh:
    """A wheeled rubbish bin."""
    lid = box([-0.31, -0.37, 1.0], [0.31, 0.33, 1.07], "rubber")
    return merge([loft(_cup(0.24, 0.3, 0.05, 1.0), "paint"), lid, _wheel(0.0, 0.26, 0.1)])


def bench() -> Mesh:
    """A park bench; one sits facing y."""
    slats = [box([-0.9, y, 0.42], [0.9, y + 0.1, 0.46], "wood") for y in (-0.2, -0.08, 0.04, 0.16)]
    back = [box([-0.9, -0.28, z], [0.9, -0.25, z + 0.1], "wood") for z in (0.58, 0.74)]
    legs = [box([x, -0.25, -0.2], [x + 0.06, 0.25, 0.42], "metal") for x in (-0.7, 0.64)]
    posts = [box([x, -0.32, 0.0], [x + 0.06, -0.26, 0.85], "metal") for x in (-0.7, 0.64)]
    return merge([*slats, *back, *legs, *posts])


def guard_rail(length: float = 4.0) -> Mesh:
    """A piece of guard rail: a corrugated band on posts, its face towards -y."""
    profile = [(0.0, 0.45), (-0.08, 0.53), (0.0, 0.6), (-0.08, 0.67), (0.0, 0.76)]
    a, b = ([[x, y, z] for y, z in profile] for x in (-length / 2, length / 2))
    band = quads([[a[k], b[k], b[k + 1], a[k + 1]] for k in range(4)], "metal")
    return merge([band, box([-0.04, 0.0, -0.5], [0.04, 0.12, 0.72], "metal")])


def noise_barrier(length: float = 4.0) -> Mesh:
    """A panel of a noise barrier between two steel posts."""
    w = length / 2
    slabs = [box([-w, -0.08, z], [w, 0.08, z + 2.0], "concrete") for z in (-0.6, 1.4)]
    x = np.arange(-w + 0.4, w - 0.1, 0.8)
    ribs = [[[a, -0.13, 0.0], [a + 0.3, -0.13, 0.0], [a + 0.3, -0.13, 3.2], [a, -0.13, 3.2]] for a in x]
    return merge([*slabs, quads(ribs, "wood"), box([-w - 0.1, -0.16, -0.6], [-w + 0.1, 0.16, 3.5], "metal")])


def gantry(left: float, right: float) -> Mesh:
    """A sign bridge across a carriageway from y = right to y = left, traffic coming from -x."""
    legs = [box([-0.2, y - 0.2, -0.5], [0.2, y + 0.2, 7.0], "metal") for y in (left, right)]
    beams = [box([-0.15, right, z], [0.15, left, z + 0.15], "metal") for z in (5.9, 6.9)]
    struts = [box([-0.05, y, 5.9], [0.05, y + 0.1, 7.0], "metal") for y in np.arange(right, left, 1.5)]
    middle = (left + right) / 2
    boards = [box([-0.35, middle + d - 1.7, 5.6], [-0.22, middle + d + 1.7, 7.6], "sign") for d in (-3.0, 2.0)]
    return merge([*legs, *beams, *struts, *boards])


def _wheel(x: float, y: float, radius: float) -> Mesh:
    turn = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    rim = np.column_stack([x + radius * np.cos(turn), np.full(10, y), radius + radius * np.sin(turn)])
    out = np.array([0.0, 0.02 * np.sign(y), 0.0])
    hub = (rim - [x, 0, radius]) * [0.6, 1, 0.6] + [x, 0, radius] + 1.3 * out
    return merge([loft([rim - 10 * out, rim + out], "rubber"), fan(hub, MATERIAL["metal"])])


def _lights(x: float, half: float) -> Mesh:
    lamps = [[[x, y, 0.62], [x, y + 0.3, 0.62], [x, y + 0.3, 0.74], [x, y, 0.74]] for y in (-0.8 * half, 0.4 * half)]
    plate = [[[x, -0.26, 0.42], [x, 0.26, 0.42], [x, 0.26, 0.53], [x, -0.26, 0.53]]]
    return merge([quads(lamps, "glass"), quads(plate, "sign")])


def _cup(low: float, high: float, bottom: float, top: float) -> NDArray[np.float64]:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.stack([np.column_stack([r * corners, np.full(4, z)]) for r, z in ((low, bottom), (high, top))])


def _feet(stride: float) -> tuple[tuple[float, float], tuple[float, float]]:
    return (stride, 0.1), (-stride, -0.1)
