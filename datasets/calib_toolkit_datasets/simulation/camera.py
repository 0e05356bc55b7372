"""A simulated camera: rays through every pixel at its own instant, daylight, exposure, blur and noise."""

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, DataError
from calib_toolkit_datasets.simulation import materials
from calib_toolkit_datasets.simulation.surfaces import Hits, Scene
from calib_toolkit_datasets.simulation.texture import GREY, albedo, clouds
from calib_toolkit_datasets.simulation.vehicle import TruePath

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]

PSF = 0.6
"""Standard deviation of the lens's blur, pixels."""
ELECTRONS = 10_000.0
"""Electrons of a pixel that is just white: the photon noise is their square root."""
READ_NOISE = 8.0
"""Electrons."""
GAMMA = 2.0
BRIGHTNESS = 0.4
"""Mean of a well exposed picture, of 1."""
VISIBILITY = 1500.0
"""Metres over which haze swallows 63 % of the contrast."""
SPREAD = ((-1 / 3, 1 / 3), (1 / 3, -1 / 3))
"""Where a pixel at an edge gets two more rays, pixels right of and below its centre."""
LEDGE = 0.04
"""Metres by which one surface lies behind its neighbour to make an edge."""


@dataclass(frozen=True)
class CameraModel:
    """A camera with OpenCV's distortion; ``intrinsics.size`` is needed. colour: or grey.

    readout: seconds from the first row's exposure to the last row's, 0 for a global shutter.
    """

    intrinsics: CameraIntrinsics
    colour: bool = True
    readout: float = 0.0

    @cached_property
    def rays(self) -> Floats:
        """Point at depth one that each pixel's centre sees, (h, w, 3), camera axes.

        Raises DataError where the distortion can not be inverted within 0.01 pixels, or without a size.
        """
        return _rays(self.intrinsics)


@dataclass(frozen=True)
class Daylight:
    """Sun and sky. sun: (3,) unit, towards it, world. clouds: where in its tile the cloud pattern starts, (2,)."""

    sun: Floats
    clouds: Floats

    def sky(self, directions: Floats, colour: bool) -> Floats:
        """The sky's light from unit directions, (n, 3) -> (n, 3) or (n, 1): blue above, pale below, clouds."""
        up = np.maximum(directions[:, 2], 0)
        height = np.sqrt(up)[:, None]
        blue = _tint((1.7, 1.6, 1.5), colour) * (1 - height) + _tint((1.5, 0.85, 0.4), colour) * height
        # seen from below, a layer of clouds thins out towards the horizon
        plane = directions[:, :2] * (np.float32(0.12) / (up + np.float32(0.15)))[:, None] + self.clouds
        cover = (clouds(plane) * np.minimum(4 * up, 1))[:, None]
        glow = np.maximum(directions @ self.sun, 0)[:, None] ** 40
        return np.asarray(blue + cover * (_tint((2.0, 2.0, 2.0), colour) - blue) + glow, np.float32)

    def colours(self, colour: bool) -> tuple[Floats, Floats, Floats]:
        """Light of the sun on a surface that faces it, of the whole sky, and of the haze, (3,) or (1,) each."""
        lights = ((2.3, 2.6, 2.75), (0.52, 0.43, 0.36), (1.05, 1.0, 0.95))
        sun, sky, haze = (_tint(light, colour) for light in lights)
        return sun, sky, haze


def daylight(seed: int) -> Daylight:
    """A day with the sun from 25 to 60 degrees high."""
    rng = np.random.default_rng([seed, 2])
    height, heading = np.radians(rng.uniform(25, 60)), rng.uniform(0, 2 * np.pi)
    sun = [np.cos(height) * np.cos(heading), np.cos(height) * np.sin(heading), np.sin(height)]
    return Daylight(np.array(sun, np.float32), rng.random(2).astype(np.float32))


def render(
    camera: CameraModel,
    scene: Scene,
    path: TruePath,
    T_vehicle_camera: Array,
    stamp: float,
    light: Daylight,
    rng: np.random.Generator,
) -> Image:
    """The picture with its exposure centred on ``stamp``: (h, w) grey, or (h, w, 3) blue, green, red.

    stamp: true seconds, of the middle row if the shutter rolls. The exposure follows this picture alone, and all
    noise comes from ``rng``, so that pictures can be made in any order. T_vehicle_camera: z ahead, x right, y down.
    """
    import cv2

    cv2.setNumThreads(1)  # pictures are made in parallel
    radiance = _view(camera, scene, path, T_vehicle_camera, stamp, light)
    blurred = cv2.GaussianBlur(radiance, (0, 0), PSF, borderType=cv2.BORDER_REPLICATE)
    return _expose(np.asarray(blurred, np.float32).reshape(radiance.shape), rng)


def _tint(light: tuple[float, float, float], colour: bool) -> Floats:
    bgr = np.array(light, np.float32)
    return bgr if colour else (bgr @ GREY)[None]


@cache
def _mirrors() -> Floats:
    return materials.mirrors()


def _rays(intrinsics: CameraIntrinsics) -> Floats:
    import cv2

    if intrinsics.size is None:
        raise DataError("a simulated camera needs the size of its images; give CameraIntrinsics a size")
    w, h = intrinsics.size
    K, distortion = np.asarray(intrinsics.K, float), np.asarray(intrinsics.distortion, float)
    pixels = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=2).reshape(-1, 2).astype(float)
    xy = np.asarray(cv2.undistortPoints(pixels[:, None], K, distortion), float).reshape(-1, 2)
    for _ in range(20):
        # OpenCV stops early; Newton steps finish, with the slope of the map itself from pixel to pixel
        points = np.column_stack([xy, np.ones(len(xy))])
        seen = np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0], float).reshape(-1, 2)
        left = pixels - seen
        worst = np.abs(left).max()
        if not 1e-3 < worst < 1e4:
            break
        down, across = (slope.reshape(-1, 2) for slope in np.gradient(xy.reshape(h, w, 2), axis=(0, 1)))
        xy = xy + left[:, :1] * across + left[:, 1:] * down
    if not worst < 0.01:
        raise DataError(
            f"the distortion {distortion.tolist()} can not be undone everywhere in a picture of {w} x {h} pixels, so "
            "there is no ray for each pixel; give milder coefficients or a longer focal length"
        )
    return np.column_stack([xy, np.ones(len(xy))]).reshape(h, w, 3).astype(np.float32)


@dataclass(frozen=True)
class _Rays:
    """origins: (n, 3) world metres; directions: (n, 3) unit; stamps: (n,) seconds."""

    origins: Array
    directions: Floats
    stamps: Array

    def __getitem__(self, chosen: NDArray[np.intp]) -> "_Rays":
        return _Rays(self.origins[chosen], self.directions[chosen], self.stamps[chosen])

    def cast(self, scene: Scene) -> Hits:
        return scene.cast(self.origins, self.directions.astype(np.float64), self.stamps)


def _view(camera: CameraModel, scene: Scene, path: TruePath, T: Array, stamp: float, light: Daylight) -> Floats:
    """Light that arrives at each pixel, (h, w, 1) or (h, w, 3)."""
    h, w = camera.rays.shape[:2]
    rows = stamp + camera.readout * ((np.arange(h) + 0.5) / h - 0.5)
    if rows[0] < path.stamps[0] or rows[-1] > path.stamps[-1]:
        raise DataError(f"no picture can be taken at {stamp:.3f} s, outside the simulated drive")
    T_world_camera = np.broadcast_to(path.at(rows if camera.readout else rows[:1]) @ T, (h, 4, 4))
    R = T_world_camera[:, :3, :3].astype(np.float32)
    towards = (camera.rays @ np.swapaxes(R, 1, 2)).reshape(-1, 3)
    rays = _Rays(np.repeat(T_world_camera[:, :3, 3], w, axis=0), _unit(towards), np.repeat(rows, w))
    hits = rays.cast(scene)
    lit = _soft(scene, rays, hits, light, h, w)
    seen = _radiance(camera, hits, rays, lit, light)
    # one ray is not enough where surfaces meet, or sun and shade
    penumbra = _penumbra(lit, h, w)
    edges = np.flatnonzero(_outlines(hits, h, w) | penumbra)
    lit, unsure = lit[edges], np.flatnonzero(penumbra[edges])
    for x, y in SPREAD:
        step = R @ np.array([x / camera.intrinsics.K[0, 0], y / camera.intrinsics.K[1, 1], 0], np.float32)
        part = replace(rays[edges], directions=_unit(towards[edges] + step[edges // w]))
        hits = part.cast(scene)
        lit[unsure] = _sunlit(scene, part[unsure], hits[unsure], light)
        seen[edges] += _radiance(camera, hits, part, lit, light)
    seen[edges] /= 1 + len(SPREAD)
    return seen.reshape(h, w, -1)


def _unit(v: Floats) -> Floats:
    return np.asarray(v / np.sqrt(np.einsum("ni,ni->n", v, v))[:, None], np.float32)


def _soft(scene: Scene, rays: _Rays, hits: Hits, light: Daylight, h: int, w: int) -> Floats:
    """Where the sun shines, (n,), asked for every second pixel of every second row and interpolated."""
    import cv2

    asked = np.arange(h * w).reshape(h, w)[::2, ::2]
    lit = _sunlit(scene, rays[asked.ravel()], hits[asked.ravel()], light).reshape(asked.shape)
    halve = np.array([[0.5, 0, 0], [0, 0.5, 0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    lit = np.asarray(cv2.warpAffine(lit, halve, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE), np.float32)
    return lit.ravel()


def _sunlit(scene: Scene, rays: _Rays, hits: Hits, light: Daylight) -> Floats:
    """1 where nothing stands between what was hit and the sun, else 0, (n,)."""
    lit = np.ones(len(hits.distance), np.float32)
    asked = np.flatnonzero(np.isfinite(hits.distance) & (hits.normal_world @ light.sun > 0))
    part = rays[asked]
    surface = part.origins + part.directions * hits.distance[asked, None] + 0.02 * hits.normal_world[asked]
    to_sun = np.repeat(light.sun[None], len(asked), axis=0)
    lit[asked] = np.isinf(_Rays(surface, to_sun, part.stamps).cast(scene).distance)
    return lit


def _penumbra(lit: Floats, h: int, w: int) -> NDArray[np.bool_]:
    """Pixels near a border of sun and shade, (n,)."""
    import cv2

    soft = (np.abs(lit - 0.5) < 0.49).reshape(h, w)
    # a thin shadow slips between the rays that were asked for
    return np.asarray(cv2.dilate(soft.astype(np.uint8), np.ones((3, 5), np.uint8)) > 0).ravel()


def _outlines(hits: Hits, h: int, w: int) -> NDArray[np.bool_]:
    """Pixels where two surfaces meet, (n,): of two objects, at an angle, or one behind the other."""
    struck = np.isfinite(hits.distance).reshape(h, w)
    surface = np.where(struck, (hits.material + hits.tone).reshape(h, w), -1)
    normal, position = hits.normal.reshape(h, w, 3), hits.position.reshape(h, w, 3)
    found = np.zeros((h, w), bool)
    for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        step = np.abs(np.einsum("...i,...i", normal[a], position[b] - position[a])) > LEDGE
        step |= np.einsum("...i,...i", normal[a], normal[b]) < 0.8
        step &= struck[a]
        step |= surface[a] != surface[b]
        found[a] |= step
        found[b] |= step
    return found.ravel()


def _radiance(camera: CameraModel, hits: Hits, rays: _Rays, lit: Floats, light: Daylight) -> Floats:
    """Light that comes back along each ray, (n, 1) or (n, 3)."""
    struck = np.isfinite(hits.distance)
    seen = np.empty((len(lit), 3 if camera.colour else 1), np.float32)
    seen[~struck] = light.sky(rays.directions[~struck], camera.colour)
    surfaces = np.flatnonzero(struck)
    hits, lit, towards = hits[surfaces], lit[surfaces], rays.directions[surfaces]
    normal, distance = hits.normal_world, hits.distance[:, None]
    facing = -np.einsum("ni,ni->n", normal, towards)
    footprint = hits.distance / np.float32(camera.intrinsics.K[0, 0]) / np.sqrt(np.maximum(facing, 0.01))
    sun, ambient, haze = light.colours(camera.colour)
    arriving = (lit * np.maximum(normal @ light.sun, 0))[:, None] * sun + (0.55 + 0.45 * normal[:, 2:]) * ambient
    out = albedo(hits, footprint, camera.colour).reshape(arriving.shape) * arriving
    _mirror(out, hits, towards, facing, light, camera.colour)
    clear = np.exp(-distance / np.float32(VISIBILITY))
    seen[surfaces] = haze + clear * (out - haze)
    return seen


def _mirror(out: Floats, hits: Hits, towards: Floats, facing: Floats, light: Daylight, colour: bool) -> None:
    """Adds what smooth surfaces reflect: the sky above, the street's average below (Schlick's approximation)."""
    share = _mirrors()[hits.material]
    smooth = np.flatnonzero(share > 0)
    share, normal, facing = share[smooth], hits.normal_world[smooth], facing[smooth]
    share = share + (1 - share) * (1 - np.clip(facing, 0, 1)) ** 5
    reflected = towards[smooth] + 2 * facing[:, None] * normal
    _, ambient, _ = light.colours(colour)
    above = np.clip(4 * reflected[:, 2:], 0, 1)
    image = above * light.sky(reflected, colour) + (1 - above) * np.float32(0.4) * ambient
    out[smooth] += share[:, None] * (image - out[smooth])


def _expose(radiance: Floats, rng: np.random.Generator) -> Image:
    """What the sensor makes of the light: gain for the right mean brightness, noise, gamma, eight bits."""
    sample = radiance[::8, ::8]
    wanted = BRIGHTNESS * (1 + 0.02 * rng.standard_normal())
    low, high = -20.0, 20.0
    for _ in range(20):
        middle = (low + high) / 2
        mean = np.mean(np.minimum(sample * np.exp2(middle), 1) ** (1 / GAMMA))
        low, high = (middle, high) if mean < wanted else (low, middle)
    electrons = radiance * np.float32(np.exp2(low) * ELECTRONS)
    np.clip(electrons, 0, 2 * ELECTRONS, out=electrons)
    noise = rng.standard_normal(electrons.shape, dtype=np.float32)
    electrons += noise * np.sqrt(electrons + np.float32(READ_NOISE**2))
    steps = np.clip(electrons * np.float32(4095 / ELECTRONS) + np.float32(0.5), 0, 4095).astype(np.uint16)
    curve = np.rint(255 * (np.arange(4096) / 4095) ** (1 / GAMMA)).astype(np.uint8)
    return curve[steps[:, :, 0] if steps.shape[2] == 1 else steps]
