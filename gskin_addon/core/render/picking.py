# SPDX-License-Identifier: GPL-3.0-or-later
"""Which object's splats are seen at a pixel: what a click on drawn splats means."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..rig.quaternion import quat_to_matrix
from .drawn_splats import DrawnSplats
from .screen_space import DILATION, covariances, is_orthographic, project

SEEN = 0.5
"""Least alpha of a pixel at which splats are seen rather than what is behind them."""
_REACH = 3.4
"""Standard deviations beyond which even an opaque splat is below 1/255."""


def pick(
    objects: Sequence[DrawnSplats], view: ArrayLike, projection: ArrayLike, size: tuple[int, int], pixel: ArrayLike
) -> tuple[int, float] | None:
    """The object with the largest share of the pixel's colour, and the depth in metres at which splats have covered
    half of it; None where they cover less than `SEEN`.

    view, projection (4, 4) as OpenGL has them, size: (height, width), pixel: (x, y) from the upper left corner.
    """
    at = np.asarray(pixel, np.float64)
    found = [_alphas_at(splats, view, projection, size, at) for splats in objects]
    alpha, depth = (np.concatenate([one[k] for one in found]) if found else np.zeros(0) for k in range(2))
    owner = np.repeat(np.arange(len(found)), [len(one[0]) for one in found])
    order = np.argsort(depth)
    alpha, owner, depth = alpha[order], owner[order], depth[order]
    left = np.cumprod(1.0 - alpha)
    if len(alpha) == 0 or 1.0 - left[-1] < SEEN:
        return None
    shares = np.bincount(owner, alpha * np.concatenate([[1.0], left[:-1]]), len(found))
    return int(np.argmax(shares)), float(depth[np.argmax(left <= 1.0 - SEEN)])


def _alphas_at(
    splats: DrawnSplats, view: ArrayLike, projection: ArrayLike, size: tuple[int, int], at: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Alphas (M,) and depths (M,) of the splats that reach a pixel."""
    linear = np.asarray(view, np.float64) @ splats.matrix
    points = splats.points @ linear[:3, :3].T + linear[:3, 3]
    front = np.ones(splats.count, bool) if is_orthographic(projection) else points[:, 2] < -1e-6
    index = np.flatnonzero(front & (splats.opacities >= 1 / 255))
    points = points[index]
    pixels, depth = project(points, projection, size)
    P = np.asarray(projection, np.float64)
    per_metre = max(abs(P[0, 0]) * size[1], abs(P[1, 1]) * size[0]) / 2
    # A bound of the footprint: the longest axis, seen by rays that stand askew by at most the lens.
    growth = np.cbrt(max(abs(np.linalg.det(linear[:3, :3])), 1e-30)) * 2.0
    longest = splats.scales[index].max(axis=1, initial=0.0) * growth * per_metre
    longest = longest if is_orthographic(P) else longest / depth
    near = np.linalg.norm(pixels - at, axis=1) < _REACH * np.sqrt(longest**2 + DILATION)
    index, points, pixels, depth = index[near], points[near], pixels[near], depth[near]
    axes = quat_to_matrix(splats.rotations[index].astype(np.float64)) * splats.scales[index][:, None, :]
    cov = covariances(linear[:3, :3] @ axes, points, P, size) + DILATION * np.eye(2)
    away = (at - pixels) * [1.0, -1.0]
    squared = np.einsum("ni,nij,nj->n", away, np.linalg.inv(cov), away)
    alpha = np.minimum(splats.opacities[index] * np.exp(-0.5 * squared), 0.99)
    kept = alpha >= 1 / 255
    return alpha[kept], depth[kept]
