"""What each sensor reads when the base moves by a twist, and how that changes with the twist and with its pose.

With ``w`` the base's turn and ``p = V(w) u`` its shift, a sensor at ``(R, t)`` reads ``R^T ((R_w - I) t + p)`` and
``R^T w``: equations (3) and (10) of the paper, solved for the sensor's motion.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3

Array = NDArray[np.float64]

UNSEEN = 0.003
"""Metres: what passes between two readings of the base, and so turns the direction of a short travel."""


@dataclass(frozen=True)
class Linear:
    """Residuals of n readings of d numbers each, and how what was predicted changes.

    residual: (n, d), measured less predicted. by_twist: (n, d, 6). by_sensor: (n, d, 9) with ``(dt, delta)`` of the
    sensor's pose and its bias, base axes. cov: (n, d, d) of the reading, as stated. shown: (n, d, 6) how the residual
    changes with what is read. usable: (n,).
    """

    residual: Array
    by_twist: Array
    by_sensor: Array
    cov: Array
    shown: Array
    usable: NDArray[np.bool_]


def linear(T: Array, bias: Array, twist: Array, vec: Array, cov: Array, has_scale: bool) -> Linear:
    """Readings of a sensor at T (4, 4) against the base's twists (n, 6). vec: (n, 6), cov: (n, 6, 6), of ``Motions``.

    bias: (3,) as of :func:`read`. A sensor without scale is compared by the direction of its travel.
    """
    predicted, by_twist, by_sensor = read(T, bias, twist)
    if not has_scale:
        return _directed(vec, predicted, by_twist, by_sensor, cov)
    shown = np.broadcast_to(np.eye(6), cov.shape)
    return Linear(vec - predicted, by_twist, by_sensor, cov, shown, np.ones(len(vec), dtype=bool))


def read(T: Array, bias: Array, twist: Array) -> tuple[Array, Array, Array]:
    """What a sensor at T reads (n, 6), with its derivatives by the twist (n, 6, 6) and by the sensor (n, 6, 9).

    bias: (3,) radians, base axes, by which its travel is turned against its turns; zero of a sensor without fault.
    """
    R, t, turned = T[:3, :3], T[:3, 3], se3.exp_so3(bias)
    u, w = twist[:, :3], twist[:, 3:]
    V, R_w = se3.left_jacobian(w), se3.exp_so3(w)
    swing = R_w - np.eye(3)
    shift = (swing @ t + (V @ u[..., None])[..., 0]) @ turned.T
    by_twist, by_sensor = np.zeros((len(u), 6, 6)), np.zeros((len(u), 6, 9))
    by_twist[:, :3, :3] = turned @ V
    by_twist[:, :3, 3:] = turned @ (_travel_by_turn(u, w) - R_w @ se3.skew(t) @ se3.left_jacobian(-w))
    by_twist[:, 3:, 3:] = np.eye(3)
    by_sensor[:, :3, :3] = turned @ swing
    by_sensor[:, :3, 3:6] = se3.skew(shift)
    by_sensor[:, 3:, 3:6] = se3.skew(w)
    by_sensor[:, :3, 6:] = -se3.skew(shift) @ se3.left_jacobian(bias)
    to_sensor = np.kron(np.eye(2), R.T)
    return np.concatenate([shift @ R, w @ R], axis=1), to_sensor @ by_twist, to_sensor @ by_sensor


def _travel_by_turn(u: Array, w: Array) -> Array:
    """Derivative of ``V(w) u`` by w, (n, 3, 3), with ``V = I + a [w] + b [w]^2``."""
    squared = np.einsum("ni,ni->n", w, w)
    small = squared < 1e-4
    th = np.sqrt(np.where(small, 1.0, squared))
    a = np.where(small, 1 / 2 - squared / 24, (1 - np.cos(th)) / th**2)
    b = np.where(small, 1 / 6 - squared / 120, (th - np.sin(th)) / th**3)
    # derivatives by the angle, over the angle
    da = np.where(small, -1 / 12 + squared / 180, (th * np.sin(th) - 2 * (1 - np.cos(th))) / th**4)
    db = np.where(small, -1 / 60 + squared / 1260, ((1 - np.cos(th)) * th - 3 * (th - np.sin(th))) / th**5)
    wu = np.cross(w, u)
    wwu = np.cross(w, wu)
    a, b, da, db, dot = (x[:, None, None] for x in (a, b, da, db, np.einsum("ni,ni->n", w, u)))
    by_square = dot * np.eye(3) + _outer(w, u) - 2 * _outer(u, w)
    return -a * se3.skew(u) + da * _outer(wu, w) + b * by_square + db * _outer(wwu, w)


def _outer(x: Array, y: Array) -> Array:
    return x[:, :, None] * y[:, None, :]


def _directed(vec: Array, predicted: Array, by_twist: Array, by_sensor: Array, cov: Array) -> Linear:
    """How far the predicted travel passes by the measured direction, as two angles, and then the turn."""
    along, travel = vec[:, :3], predicted[:, :3]
    length = np.maximum(np.linalg.norm(travel, axis=1), 1e-9)
    other = np.where(np.abs(along[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(along, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    shown, change = np.zeros((2, len(vec), 5, 6))
    shown[:, :2, :3] = np.stack([first, np.cross(along, first)], axis=1)
    change[:, :2] = shown[:, :2] / length[:, None, None]
    shown[:, 2:, 3:] = change[:, 2:, 3:] = np.eye(3)
    residual = np.concatenate(
        [-(change[:, :2, :3] @ travel[..., None])[..., 0], vec[:, 3:] - predicted[:, 3:]], axis=1
    )
    forward = np.einsum("ni,ni->n", along, travel) > 0
    noise = shown @ cov @ np.swapaxes(shown, 1, 2)
    noise[:, [0, 1], [0, 1]] += (UNSEEN / length[:, None]) ** 2
    return Linear(residual, change @ by_twist, change @ by_sensor, noise, change, forward)
