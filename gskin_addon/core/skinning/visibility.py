# SPDX-License-Identifier: GPL-3.0-or-later
"""Which bones a splat can see: the paper's silhouette test, compiled with numba."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..render.camera import Camera
from ..rig.skeleton import Skeleton

Array = NDArray[Any]

MAX_SAMPLES = 32


def bone_visibility(
    means: Array, skeleton: Skeleton, masks: Array, cameras: Sequence[Camera], *, slack: int = 1
) -> tuple[Array, Array]:
    """Squared distance to every bone, and whether the way there stays inside the object.

    The segment from a splat to its closest point on a bone is projected into each view; where it leaves the
    object mask the two do not see each other. It is sampled at every second pixel, at most 32 times. A view
    in which the splat itself lies outside the mask (a stray, or too faint to be drawn) says nothing and is
    skipped.

    means (N, 3); masks (V, H, W) bool, one per camera, of that camera's size; `slack` pixels are added to
    each mask for the silhouette's aliasing. Returns squared distances (N, B) float64 in square metres and
    visible (N, B) bool.
    """
    masks = np.asarray(masks, dtype=bool)
    if masks.ndim != 3 or len(masks) != len(cameras):
        raise ValueError(f"masks have shape {masks.shape}, expected ({len(cameras)}, H, W)")
    for camera in cameras:
        if (camera.height, camera.width) != masks.shape[1:]:
            raise ValueError(f"masks are {masks.shape[1:]}, a camera is {(camera.height, camera.width)}")
    projections = np.array([projection_matrix(camera) for camera in cameras])
    squared = np.empty((len(means), skeleton.count))
    visible = np.empty((len(means), skeleton.count), dtype=np.bool_)
    _visibility_kernel(
        np.ascontiguousarray(means, dtype=np.float64),
        np.ascontiguousarray(skeleton.heads),
        np.ascontiguousarray(skeleton.tails),
        projections.reshape(-1, 3, 4),
        grow_masks(masks, slack).astype(np.uint8),
        _bit_reversed(MAX_SAMPLES),
        squared,
        visible,
    )
    return squared, visible


def projection_matrix(camera: Camera) -> Array:
    """K [R | t] (3, 4): homogeneous pixels of world points."""
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return k @ np.column_stack([camera.rotation, camera.translation])


def grow_masks(masks: Array, pixels: int) -> Array:
    """Masks (V, H, W) bool grown by `pixels` in the four directions, that many times."""
    for _ in range(pixels):
        grown = masks.copy()
        grown[:, 1:] |= masks[:, :-1]
        grown[:, :-1] |= masks[:, 1:]
        grown[:, :, 1:] |= masks[:, :, :-1]
        grown[:, :, :-1] |= masks[:, :, 1:]
        masks = grown
    return masks


def _bit_reversed(count: int) -> Array:
    """The fractions 1/count .. 1 in bit-reversed order: its first 2^k entries are evenly spaced and end at 1.

    Coarse samples come first, so that a segment that leaves the mask is found early.
    """
    bits = count.bit_length() - 1
    return np.array([1 - int(f"{i:0{bits}b}"[::-1], 2) / count for i in range(count)])


@njit(inline="always")
def closest_on_segment(p, a, ab, length2):  # type: ignore[no-untyped-def]
    """Parameter t in [0, 1] of the point of a + t ab that is closest to p."""
    t = ((p[0] - a[0]) * ab[0] + (p[1] - a[1]) * ab[1] + (p[2] - a[2]) * ab[2]) / length2
    return min(1.0, max(0.0, t))


@njit(parallel=True, cache=True)
def _visibility_kernel(means, heads, tails, projections, masks, fractions, squared, visible):  # type: ignore[no-untyped-def]
    views, height, width = masks.shape
    bones = len(heads)
    for n in prange(len(means)):
        p = means[n]
        u0, v0 = np.empty(views), np.empty(views)
        usable = np.zeros(views, dtype=np.bool_)
        for c in range(views):
            m = projections[c]
            z = m[2, 0] * p[0] + m[2, 1] * p[1] + m[2, 2] * p[2] + m[2, 3]
            if z <= 0:
                continue
            u0[c] = (m[0, 0] * p[0] + m[0, 1] * p[1] + m[0, 2] * p[2] + m[0, 3]) / z
            v0[c] = (m[1, 0] * p[0] + m[1, 1] * p[1] + m[1, 2] * p[2] + m[1, 3]) / z
            i, j = math.floor(v0[c]), math.floor(u0[c])
            usable[c] = 0 <= i < height and 0 <= j < width and masks[c, i, j] != 0
        q = np.empty(3)
        for b in range(bones):
            ab = tails[b] - heads[b]
            length2 = max(ab[0] * ab[0] + ab[1] * ab[1] + ab[2] * ab[2], 1e-300)
            t = closest_on_segment(p, heads[b], ab, length2)
            total = 0.0
            for k in range(3):
                q[k] = heads[b, k] + t * ab[k]
                total += (p[k] - q[k]) ** 2
            squared[n, b] = total
            sees = True
            for c in range(views):
                if not usable[c]:
                    continue
                m = projections[c]
                z = m[2, 0] * q[0] + m[2, 1] * q[1] + m[2, 2] * q[2] + m[2, 3]
                if z <= 0:
                    sees = False
                    break
                du = (m[0, 0] * q[0] + m[0, 1] * q[1] + m[0, 2] * q[2] + m[0, 3]) / z - u0[c]
                dv = (m[1, 0] * q[0] + m[1, 1] * q[1] + m[1, 2] * q[2] + m[1, 3]) / z - v0[c]
                wanted = 0.5 * math.sqrt(du * du + dv * dv)
                samples = 1
                while samples < wanted and samples < len(fractions):
                    samples *= 2
                for s in range(samples):
                    i = math.floor(v0[c] + fractions[s] * dv)
                    j = math.floor(u0[c] + fractions[s] * du)
                    if i < 0 or i >= height or j < 0 or j >= width or masks[c, i, j] == 0:
                        sees = False
                        break
                if not sees:
                    break
            visible[n, b] = sees
