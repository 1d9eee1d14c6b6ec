# SPDX-License-Identifier: GPL-3.0-or-later
"""Which bones a splat can see: the paper's silhouette test, in numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..render.camera import Camera
from ..rig.segments import closest_on_segment
from ..rig.skeleton import Skeleton
from ..ticks import Tick, cores, silent, work

Array = NDArray[Any]

MAX_SAMPLES = 32
_THREADS = 2
_POINTS = 2048  # at a time: small enough for the processor's cache


def bone_visibility(
    means: Array, skeleton: Skeleton, masks: Array, cameras: Sequence[Camera], *, slack: int = 1, tick: Tick = silent
) -> tuple[Array, Array]:
    """Squared distance to every bone, and whether the straight line to it stays inside the object.

    The segment from a splat to its closest point on a bone is projected into each view; where it leaves the
    object mask the two do not see each other. It is sampled at every second pixel, at most 32 times. A view
    in which the splat itself lies outside the mask (a stray, or too faint to be drawn) is skipped.

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
    masks = grow_masks(masks, slack)
    projections = [projection_matrix(camera) for camera in cameras]
    squared = np.empty((len(means), skeleton.count))
    visible = np.empty((len(means), skeleton.count), dtype=np.bool_)

    def some(begin: int, end: int, tick: Tick) -> None:
        for first in range(begin, end, _POINTS):
            rows = slice(first, min(first + _POINTS, end))
            points = np.asarray(means[rows], np.float64)
            bones = zip(skeleton.heads, skeleton.tails, strict=True)
            ends = np.stack([closest_on_segment(points, head, tail) for head, tail in bones], axis=1)
            squared[rows] = np.square(points[:, None] - ends).sum(axis=2)
            sees = np.ones(ends.shape[:2], bool)
            for projection, mask in zip(projections, masks, strict=True):
                _look(points, ends, projection, mask, sees)
            visible[rows] = sees
            tick((rows.stop - begin) / (end - begin))

    threads = min(_THREADS, cores())
    cuts = np.linspace(0, len(means), threads + 1).astype(int).tolist()
    work([partial(some, begin, end) for begin, end in pairwise(cuts) if end > begin], tick, threads)
    return squared, visible


def projection_matrix(camera: Camera) -> Array:
    """K [R | t] (3, 4): homogeneous pixels of world points."""
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return k @ np.column_stack([camera.rotation, camera.translation])


def grow_masks(masks: Array, pixels: int) -> Array:
    """Masks (V, H, W) bool grown by `pixels` in the four axis directions."""
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


def _look(points: Array, ends: Array, projection: Array, mask: Array, sees: Array) -> None:
    """sees (N, B) becomes False where the line from points (N, 3) to ends (N, B, 3) leaves the mask (H, W)."""
    height, width = mask.shape
    # An empty border: points outside the image are moved onto it.
    framed = np.pad(mask, 1).ravel()

    def inside(u: Array, v: Array) -> Array:
        i = np.minimum(np.maximum(v + 1, 0), height + 1).astype(np.int32)
        j = np.minimum(np.maximum(u + 1, 0), width + 1).astype(np.int32)
        return framed[i * (width + 2) + j]

    u0, v0, z0 = _project(points, projection)
    usable = z0 > 0
    usable[usable] = inside(u0[usable], v0[usable])
    n, b = np.nonzero(sees & usable[:, None])
    u1, v1, z1 = _project(ends[n, b], projection)
    sees[n[z1 <= 0], b[z1 <= 0]] = False
    front = z1 > 0
    n, b = n[front], b[front]
    u0, v0 = u0[n], v0[n]
    du, dv = u1[front] - u0, v1[front] - v0
    wanted = 0.5 * np.sqrt(du * du + dv * dv)
    fractions = _bit_reversed(MAX_SAMPLES)
    done, samples = 0, 1
    while len(n):
        part = fractions[done:samples]
        held = inside(u0[:, None] + part * du[:, None], v0[:, None] + part * dv[:, None]).all(axis=1)
        sees[n[~held], b[~held]] = False
        on = held & (wanted > samples)
        if samples == MAX_SAMPLES:
            break
        done, samples = samples, 2 * samples
        n, b, u0, v0, du, dv, wanted = (a[on] for a in (n, b, u0, v0, du, dv, wanted))


def _project(points: Array, projection: Array) -> tuple[Array, Array, Array]:
    """Pixels u, v and depth z (N,) of points (N, 3); pixels mean nothing where z is not positive."""
    u, v, z = projection[:, :3] @ points.T + projection[:, 3:]
    safe = np.where(z > 0, z, 1.0)
    return u / safe, v / safe, z
