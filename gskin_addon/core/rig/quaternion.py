# SPDX-License-Identifier: GPL-3.0-or-later
"""Quaternions (w, x, y, z) and rotation matrices; every function works on any leading shape."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def normalize(q: Array) -> Array:
    """Unit quaternions (..., 4); a zero quaternion becomes the identity."""
    q = np.asarray(q)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    identity = np.array([1, 0, 0, 0], dtype=q.dtype)
    safe = length > np.finfo(length.dtype).tiny
    return np.where(safe, q / np.where(safe, length, 1), identity)


def quat_multiply(a: Array, b: Array) -> Array:
    """Hamilton product a b, (..., 4): the rotation b first, then a."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quat_to_matrix(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), which are normalised first."""
    w, x, y, z = np.moveaxis(normalize(q), -1, 0)
    rows = [
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
        np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
        np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1),
    ]
    return np.stack(rows, axis=-2)


def matrix_to_quat(matrix: Array) -> Array:
    """Unit quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3).

    Takes the row of q q^T (times four) with the largest diagonal, which stays accurate near half turns.
    """
    m = np.asarray(matrix)
    m00, m01, m02 = m[..., 0, 0], m[..., 0, 1], m[..., 0, 2]
    m10, m11, m12 = m[..., 1, 0], m[..., 1, 1], m[..., 1, 2]
    m20, m21, m22 = m[..., 2, 0], m[..., 2, 1], m[..., 2, 2]
    ww, xx, yy, zz = 1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m10 + m01, m02 + m20, m21 + m12
    outer = np.stack(
        [
            np.stack([ww, wx, wy, wz], axis=-1),
            np.stack([wx, xx, xy, xz], axis=-1),
            np.stack([wy, xy, yy, yz], axis=-1),
            np.stack([wz, xz, yz, zz], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.stack([ww, xx, yy, zz], axis=-1), axis=-1)
    q = normalize(np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :])
    return np.where(q[..., :1] < 0, -q, q)


def axis_angle_to_matrix(axis: Array, angle: Array) -> Array:
    """Rotation matrices (..., 3, 3) about axes (..., 3) by angles (...) in radians (Rodrigues)."""
    axis = np.asarray(axis, dtype=np.float64)
    axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    half = np.asarray(angle, dtype=np.float64)[..., None] / 2
    axis, half = np.broadcast_arrays(axis, np.broadcast_to(half, (*half.shape[:-1], 3)))
    return quat_to_matrix(np.concatenate([np.cos(half[..., :1]), np.sin(half) * axis], axis=-1))


def nearest_rotation(matrix: Array) -> Array:
    """The rotation (..., 3, 3) nearest to a linear map (..., 3, 3): the R of its polar decomposition R S."""
    u, _, vt = np.linalg.svd(matrix)
    flip = np.ones(u.shape[:-1], dtype=u.dtype)
    flip[..., 2] = np.sign(np.linalg.det(u @ vt))
    return (u * flip[..., None, :]) @ vt
