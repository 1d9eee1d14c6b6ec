# SPDX-License-Identifier: GPL-3.0-or-later
"""What a display needs anew for every view, off the main thread: the order of the splats, and their colours.

numpy only. Nothing here knows Blender, so a thread may run it while Blender goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..splats.cloud import SH_C0
from ..splats.sh import eval_sh
from .drawn_splats import DrawnSplats
from .screen_space import is_orthographic

Array = NDArray[np.float32]
_CHUNK = 16384
_SIGN = np.uint32(0x80000000)


def back_to_front(depths: NDArray[Any]) -> NDArray[np.intp]:
    """Index (N,) of depths (N,) from the farthest to the nearest; equal ones keep their order.

    A radix sort: float32 as whole numbers that rise alike, sorted by their lower and then their upper 16 bits, which
    numpy does in linear time.
    """
    bits = np.ascontiguousarray(depths, np.float32).view(np.uint32)
    falling = np.where(bits & _SIGN, bits, ~(bits | _SIGN))
    lower = np.argsort(falling.astype(np.uint16), kind="stable")
    upper = (falling >> np.uint32(16)).astype(np.uint16)
    return lower[np.argsort(upper[lower], kind="stable")]


def view_depths(splats: DrawnSplats, view: ArrayLike) -> Array:
    """Depths (N,) along the view axis, metres; view (4, 4): the world to view axes (looking along -z)."""
    row = (np.asarray(view, np.float64) @ splats.matrix)[2]
    depths: Array = splats.points @ (-row[:3]).astype(np.float32)
    depths -= np.float32(row[3])
    return depths


def eye_of(view: ArrayLike, projection: ArrayLike, matrix: ArrayLike) -> NDArray[np.float64]:
    """Where the rays of a view come from, in the space that matrix (4, 4) takes to the world: (4,) homogeneous.

    (x, y, z, 1) is the eye of a perspective view; (x, y, z, 0) the direction to that of an orthographic one.
    """
    inward = np.linalg.inv(np.asarray(view, np.float64) @ np.asarray(matrix, np.float64))
    if is_orthographic(projection):
        axis = inward[:3, 2]
        return np.append(axis / np.linalg.norm(axis), 0.0)
    return np.append(inward[:3, 3], 1.0)


def view_colors(splats: DrawnSplats, eye: NDArray[np.float64]) -> Array:
    """Colours (N, 3), sRGB of 0 and more, as seen from `eye` (4,) of `eye_of`.

    The harmonics stay those of the rest pose: the ray is turned back by each splat's turn q instead,
    f'(d) = f(R(q)^T d), which costs a fraction of turning coefficients.
    """
    if splats.colors is not None:
        return splats.colors
    if splats.sh.shape[1] == 1:
        return np.maximum(splats.sh[:, 0] * np.float32(SH_C0) + np.float32(0.5), np.float32(0.0))
    colors = np.empty((splats.count, 3), np.float32)
    position, parallel = eye[:3].astype(np.float32), eye[3] == 0.0
    for first in range(0, splats.count, _CHUNK):
        part = slice(first, first + _CHUNK)
        points = splats.points[part]
        rays = np.broadcast_to(-position, points.shape) if parallel else points - position
        if splats.turns is not None:
            rays = _turned_back(rays, splats.turns[part])
        rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.float32(1e-12))
        colors[part] = eval_sh(splats.sh[part], rays)
    return colors


def _turned_back(rays: Array, turns: Array) -> Array:
    """R(q)^T rays, up to length, for rays (N, 3) and quaternions (N, 4) wxyz of any length but zero."""
    w, axis = turns[:, :1], turns[:, 1:]
    across = np.cross(axis, rays)
    squared = np.einsum("ni,ni->n", turns, turns)[:, None]
    return rays * squared - 2 * w * across + 2 * np.cross(axis, across)


def arrange(
    objects: Sequence[DrawnSplats], view: ArrayLike, projection: ArrayLike
) -> tuple[NDArray[np.intp], list[Array]]:
    """Order (sum of N,) into the objects' splats, one after the other, farthest first; and colours (N, 3) of each."""
    depths = [view_depths(splats, view) for splats in objects]
    order = back_to_front(np.concatenate(depths) if depths else np.zeros(0, np.float32))
    return order, [view_colors(splats, eye_of(view, projection, splats.matrix)) for splats in objects]
