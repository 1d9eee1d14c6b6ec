# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats on the screen for matrices as OpenGL and Blender have them (x right, y up, looking along -z).

This is the arithmetic of the display's shader in numpy: for perspective and orthographic views, shifted lenses too.
`camera_matrices` gives the matrices of our own cameras.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .camera import Camera

Array = NDArray[Any]

DILATION = 0.3
"""Added to both variances of the image, in pixels squared, as in the INRIA renderer."""
EDGE = 1.3
"""Where the Jacobian is taken at most, in half images from the middle: beyond, the linear map is no approximation."""


def is_orthographic(projection: ArrayLike) -> bool:
    """Whether a projection (4, 4) has parallel rays."""
    return bool(np.asarray(projection)[3, 3] != 0.0)


def camera_matrices(camera: Camera, far: float = 1000.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """View (4, 4) and projection (4, 4) of a camera; depth from its `near` to `far` metres."""
    flip = np.diag([1.0, -1.0, -1.0])
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = flip @ camera.rotation, flip @ camera.translation
    near, projection = camera.near, np.zeros((4, 4))
    if camera.orthographic:
        projection[0, 0], projection[0, 3] = 2 * camera.fx / camera.width, 2 * camera.cx / camera.width - 1
        projection[1, 1], projection[1, 3] = 2 * camera.fy / camera.height, 1 - 2 * camera.cy / camera.height
        projection[2, 2], projection[2, 3] = 2 / (near - far), (far + near) / (near - far)
        projection[3, 3] = 1.0
        return view, projection
    projection[0, 0], projection[0, 2] = 2 * camera.fx / camera.width, 1 - 2 * camera.cx / camera.width
    projection[1, 1], projection[1, 2] = 2 * camera.fy / camera.height, 2 * camera.cy / camera.height - 1
    projection[2, 2], projection[2, 3] = (far + near) / (near - far), 2 * far * near / (near - far)
    projection[3, 2] = -1.0
    return view, projection


def window_depths(depth: Array, projection: ArrayLike) -> Array:
    """Window depths, 0 near to 1 far, of metres along the axis of view; what is infinitely far is farthest."""
    P = np.asarray(projection, np.float64)
    away = np.where(np.isfinite(depth), depth, 1.0).astype(np.float64)
    ndc = P[2, 3] - P[2, 2] * away
    if not is_orthographic(P):
        ndc = ndc / away
    return np.where(np.isfinite(depth), 0.5 * ndc + 0.5, 1.0).astype(np.float32)


def project(points: Array, projection: ArrayLike, size: tuple[int, int]) -> tuple[Array, Array]:
    """Pixels (N, 2) from the upper left corner and depths (N,) of points (N, 3) in view axes; size: (height, width)."""
    P, (height, width) = np.asarray(projection, np.float64), size
    clip = points @ P[:2, :3].T + P[:2, 3]
    depth = -points[:, 2]
    ndc = clip if is_orthographic(P) else clip / depth[:, None]
    return np.stack([(ndc[:, 0] + 1) * 0.5 * width, (1 - ndc[:, 1]) * 0.5 * height], axis=1), depth


def jacobian(points: Array, projection: ArrayLike, size: tuple[int, int]) -> Array:
    """Pixels per metre (N, 2, 3) at points (N, 3) in view axes: EWA's local linear map (Zwicker et al. 2001).

    Rows are x to the right and y up. The perspective map is taken within `EDGE` of the image.
    """
    P, (height, width) = np.asarray(projection, np.float64), size
    half = np.array([0.5 * width, 0.5 * height])
    J = np.zeros((len(points), 2, 3))
    if is_orthographic(P):
        J[:] = P[:2, :3] * half[:, None]
        return J
    depth = -points[:, 2]
    focal, shift = np.diag(P)[:2], P[:2, 2]
    ndc = np.clip(points[:, :2] * focal / depth[:, None] - shift, -EDGE, EDGE)
    for axis in range(2):
        J[:, axis, axis] = focal[axis] * half[axis] / depth
        J[:, axis, 2] = (ndc[:, axis] + shift[axis]) * half[axis] / depth
    return J


def covariances(axes: Array, points: Array, projection: ArrayLike, size: tuple[int, int]) -> Array:
    """Undilated image covariances (N, 2, 2), pixels squared, of splats with axes (N, 3, 3) in columns (view axes)."""
    U = jacobian(points, projection, size) @ axes
    return U @ U.transpose(0, 2, 1)
