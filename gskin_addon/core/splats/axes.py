# SPDX-License-Identifier: GPL-3.0-or-later
"""Axis systems of splat files, and turning a whole cloud."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..ticks import Steps
from .cloud import AnyArray, FloatArray, Floats, SplatCloud
from .loaded import pieces
from .sh import rotate_sh

_UP_ROTATIONS = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}
_NORMAL = ("nx", "ny", "nz")
UP_AXES = tuple(_UP_ROTATIONS)
"""Names of the axes that can be "up" in a splat file."""


def up_rotation(up: str) -> NDArray[np.float64]:
    """(3, 3) rotation from a file whose up axis is `up` ("z", "y" or "-y") to Blender's Z-up world.

    z: unchanged; y: (x, y, z) -> (x, -z, y), as glTF; -y: (x, y, z) -> (x, z, -y), as COLMAP.
    Raises InputError for another name.
    """
    if up not in _UP_ROTATIONS:
        raise InputError(f"{up!r} is no up axis; use one of {', '.join(UP_AXES)}.")
    return np.array(_UP_ROTATIONS[up], dtype=np.float64)


def rotation_quat(R: Floats) -> NDArray[np.float64]:
    """Unit quaternion (4,) wxyz, w >= 0, of a rotation matrix (3, 3).

    The eigenvector of the largest eigenvalue of Bar-Itzhack's symmetric matrix, stable for every angle.
    """
    m = np.asarray(R, dtype=np.float64)
    K = np.empty((4, 4))
    K[0, 0] = np.trace(m)
    K[0, 1:] = K[1:, 0] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    K[1:, 1:] = m + m.T - np.trace(m) * np.eye(3)
    quat: NDArray[np.float64] = np.linalg.eigh(K)[1][:, -1]
    return quat if quat[0] >= 0.0 else -quat


def turn_quats(quat: Floats, quats: FloatArray) -> FloatArray:
    """Unit quaternions (N, 4) wxyz turned by one quaternion (4,): the products quat * quats, normalised."""
    w, x, y, z = (float(value) for value in quat)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    turned = quats.astype(np.float64) @ left.T
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return turned.astype(np.float32)


def rotate_cloud(cloud: SplatCloud, R: Floats) -> SplatCloud:
    """The cloud turned about the origin by the rotation (3, 3): centres, quaternions, SH and normals.

    Raises ValueError where R is no rotation (mirrored or scaled: a splat cannot follow it).
    """
    R = np.asarray(R, dtype=np.float64)
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-5) or np.linalg.det(R) < 0.0:
        raise ValueError("R is no rotation matrix")
    if np.array_equal(R, np.eye(3)):
        return cloud
    extra: dict[str, AnyArray] = dict(cloud.extra)
    if all(name in extra for name in _NORMAL):
        normals = np.stack([extra[name] for name in _NORMAL], axis=1) @ R.T
        extra.update({name: normals[:, i].astype(extra[name].dtype) for i, name in enumerate(_NORMAL)})
    return replace(
        cloud,
        means=(cloud.means.astype(np.float64) @ R.T).astype(np.float32),
        quats=turn_quats(rotation_quat(R), cloud.quats),
        sh=rotate_sh(cloud.sh, R),
        extra=extra,
        offset=R @ cloud.offset,
        up="",
    )


def rotate_in_place(cloud: SplatCloud, R: Floats) -> Steps[SplatCloud]:
    """`rotate_cloud` piece by piece, into the arrays of `cloud` itself, which must be nobody else's."""
    R = np.asarray(R, dtype=np.float64)
    if np.array_equal(R, np.eye(3)):
        return cloud
    for rows in pieces(cloud.count):
        turned = rotate_cloud(cloud.select(rows), R)
        for name in ("means", "quats", "sh"):
            getattr(cloud, name)[rows] = getattr(turned, name)
        for name in _NORMAL:
            if name in cloud.extra:
                cloud.extra[name][rows] = turned.extra[name]
        yield rows.stop / cloud.count
    return replace(cloud, offset=R @ cloud.offset, up="")
