# SPDX-License-Identifier: GPL-3.0-or-later
"""One frame of *Render Splats*: the splats of all objects in one picture, behind the meshes that stand before them."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..rig.covariance import transform_gaussians
from ..rig.quaternion import matrix_to_quat, quat_multiply
from . import fragments
from .camera import Camera
from .drawn_splats import DrawnSplats
from .picture import Picture
from .triangles import depth_of_triangles
from .view_order import view_colors

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Frame:
    """What is drawn: splats, the camera, and the triangles (T, 3, 3), world, of what hides splats.

    far: metres along the camera's z at which the picture ends. picture (H, W, 4): drawn elsewhere, premultiplied sRGB
    and alpha, in place of the objects.
    """

    objects: Sequence[DrawnSplats]
    camera: Camera
    triangles: Array
    far: float = np.inf
    picture: Array | None = None


def draw_frame(frame: Frame, on_progress: Callable[[float], None] | None = None) -> tuple[Picture, NDArray[np.bool_]]:
    """The picture, and the pixels (H, W) that other objects cover.

    By the numba kernels where this Python has numba, else in numpy.
    """
    camera = frame.camera
    others = depth_of_triangles(frame.triangles, camera)
    hidden = np.isfinite(others) & (others <= frame.far)
    if frame.picture is not None:
        color, alpha = frame.picture[..., :3], frame.picture[..., 3]
        return Picture(color, alpha, np.full(alpha.shape, np.inf, np.float32)), hidden
    limit = np.minimum(others, np.float32(frame.far))
    if frame.objects:
        parts = [(*in_world(splats), splats.opacities, colors_seen(splats, camera)) for splats in frame.objects]
        means, quats, scales, opacities, colors = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    else:
        means, quats, scales = np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3))
        opacities, colors = np.zeros(0), np.zeros((0, 3))
    splats = means, quats, scales, colors, opacities
    if importlib.util.find_spec("numba") is None:
        picture = fragments.draw(*splats, camera, limit, on_progress)
    else:
        from .cpu.still import draw

        picture = draw(*splats, camera, limit)
    return picture, hidden


def in_world(splats: DrawnSplats) -> tuple[Array, Array, Array]:
    """Means (N,3), quats (N,4) and scales (N,3) in world space; a matrix that stretches or shears does so to splats."""
    linear, shift = splats.matrix[:3, :3], splats.matrix[:3, 3]
    means = (splats.points @ linear.T + shift).astype(np.float32)
    size = float(np.cbrt(abs(np.linalg.det(linear))))
    turn = linear / size if size > 0.0 else linear
    if np.allclose(turn @ turn.T, np.eye(3), atol=1e-5) and np.linalg.det(turn) > 0:
        quat = matrix_to_quat(turn[None])[0]
        quats = quat_multiply(np.broadcast_to(quat, splats.rotations.shape), splats.rotations)
        return means, quats.astype(np.float32), (splats.scales * size).astype(np.float32)
    maps = np.broadcast_to(linear, (splats.count, 3, 3))
    quats, scales = transform_gaussians(splats.rotations.astype(np.float64), splats.scales, maps)
    return means, quats.astype(np.float32), scales.astype(np.float32)


def colors_seen(splats: DrawnSplats, camera: Camera) -> Array:
    """Colours (N, 3) sRGB as the camera sees them; orthographic cameras look along one direction everywhere."""
    inward = np.linalg.inv(splats.matrix)
    if camera.orthographic:
        axis = inward[:3, :3] @ -camera.forward
        return view_colors(splats, np.append(axis / np.linalg.norm(axis), 0.0))
    return view_colors(splats, np.append((inward @ np.append(camera.center, 1.0))[:3], 1.0))
