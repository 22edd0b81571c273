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


def wrap(angle: Array) -> Array:
    """An angle between -π and π.

    :param angle: [rad]
    """
    return (angle + np.pi) % (2 * np.pi) - np.pi
