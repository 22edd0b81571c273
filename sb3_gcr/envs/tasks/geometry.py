"""Attitudes from quaternions, row by row."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def yaw_and_roll(quaternion: Array) -> tuple[Array, Array]:
    """Rotation about the vertical and about the forward axis [rad], each (N,).

    :param quaternion: w, x, y, z, shape (N, 4)
    """
    w, x, y, z = quaternion.T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return yaw, roll


def into_frame(quaternion: Array, vectors: Array) -> Array:
    """World vectors in the frame of a rotated body, shape (N, 3).

    :param quaternion: of the body, w, x, y, z, shape (N, 4)
    :param vectors: shape (N, 3)
    """
    w, axis = quaternion[:, :1], -quaternion[:, 1:]
    twice = 2 * np.cross(axis, vectors)
    return vectors + w * twice + np.cross(axis, twice)


def into_world(quaternion: Array, vectors: Array) -> Array:
    """Vectors in the frame of a rotated body as world vectors, shape (N, 3).

    :param quaternion: of the body, w, x, y, z, shape (N, 4)
    :param vectors: shape (N, 3)
    """
    return into_frame(quaternion * [1, -1, -1, -1], vectors)


def wrap(angle: Array) -> Array:
    """An angle between -π and π.

    :param angle: [rad]
    """
    return (angle + np.pi) % (2 * np.pi) - np.pi


def projected_gravity(quaternion: Array) -> Array:
    """The direction of gravity in the frame of a rotated body, shape (N, 3).

    :param quaternion: of the body, w, x, y, z, shape (N, 4)
    """
    w, x, y, z = quaternion.T
    return np.stack([2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1], axis=1)


def from_euler(roll: Array, pitch: Array, yaw: Array) -> Array:
    """The quaternions w, x, y, z of turns about the fixed axes x, then y, then z; shape (…, 4).

    :param roll: about x [rad], shape (…)
    :param pitch: about y [rad], shape (…)
    :param yaw: about z [rad], shape (…)
    """
    (cr, sr), (cp, sp), (cy, sy) = (
        (np.cos(angle / 2), np.sin(angle / 2)) for angle in (roll, pitch, yaw)
    )
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def compose(first: Array, second: Array) -> Array:
    """The product of quaternions w, x, y, z: the turn ``second``, then ``first``; shape (N, 4).

    :param first: shape (N, 4)
    :param second: shape (N, 4)
    """
    w, x, y, z = first.T
    a, b, c, d = second.T
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=1,
    )


def angle_between(first: Array, second: Array) -> Array:
    """The angle of the turn that leads from one attitude to another [rad], between 0 and π.

    Four times the angle whose tangent is ‖p - q‖ / ‖p + q‖, with q on p's side; an arc cosine
    would lose half of the digits near 0.

    :param first: p, unit quaternions, shape (N, 4)
    :param second: q, unit quaternions, shape (N, 4)
    """
    difference = np.linalg.norm(first - second, axis=1)
    total = np.linalg.norm(first + second, axis=1)
    return 4 * np.arctan2(np.minimum(difference, total), np.maximum(difference, total))
