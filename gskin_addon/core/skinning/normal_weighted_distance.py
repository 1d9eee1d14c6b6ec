# SPDX-License-Identifier: GPL-3.0-or-later
"""Outward normals of splats, and bone distances weighted by them: a bone behind a splat counts as nearer than one in
front of it.

A bone lies inside its limb, behind the limb's surface. Distances that take this into account separate legs that touch
and assign the belly to the spine, not to the thigh beside it. Blender's bone heat weights its distances likewise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.nearest_points import nearest_points
from ..rig.segments import BoneSegments, closest_on_segment
from .voxel_filters import blur, slope_at
from .voxels import VoxelGrid

Array = NDArray[Any]

_CLEAR = 0.5
"""From this share of the usual density step at a surface on, the outside is certain."""

NEIGHBOURS = 32
"""Nearest splats whose normals are compared with a splat's own."""

_SPLIT, _WHOLE = 0.4, 0.8
"""Agreements above which an outward normal counts in part, and fully. Where cloth lies close to a body, only the outer
side shows which way is out: it agrees with half of the splats around it."""


def surface_normals(points: Array, neighbours: int = 12, near: Array | None = None) -> Array:
    """(N, 3) unit normals, of either sign: the direction in which the nearest splats spread least.

    near (N, >= neighbours): indices of each splat's nearest, itself included, if they are known.
    """
    k = min(neighbours, len(points))
    index = nearest_points(points, points, k)[1] if near is None else near[:, :k]
    around = points[index]
    around = around - around.mean(axis=1, keepdims=True)
    scatter = np.einsum("nki,nkj->nij", around, around)
    return np.linalg.eigh(scatter)[1][:, :, 0]


def outward_normals(points: Array, normals: Array, grid: VoxelGrid) -> Array:
    """Normals (N, 3) that point out of the filled object; their length is the certainty: 1 on a closed body, down to
    0 on what is thinner than a voxel, such as a leaf.

    points, normals (N, 3), unit, of either sign; grid: of the same object.
    """
    steepest = slope_at(blur(grid.solid), grid.coordinates(points) - 0.5)
    fall = -np.einsum("nk,nk->n", steepest, normals)
    usual = float(np.median(np.abs(fall))) or 1.0
    return np.asarray(normals * np.clip(fall / (_CLEAR * usual), -1, 1)[:, None])


def consistent_normals(
    points: Array, out: Array, nearest: Array, size: float, around: tuple[Array, Array] | None = None
) -> Array:
    """`out` (N, 3), shortened where neighbouring splats disagree: the two sides of cloth do not tell where its bones
    are.

    Neighbours are within half of nearest (N,), the distance to the closest bone, so that both sides of a thin finger
    are not mixed; size: the object's diagonal; around: distances and indices (N, NEIGHBOURS) of each splat's nearest,
    if they are known.
    """
    way, near = around or nearest_points(points, points, min(NEIGHBOURS, len(points)))
    close = way <= np.clip(0.5 * nearest, 0.005 * size, 0.05 * size)[:, None]
    mean = (out[near] * close[..., None]).sum(axis=1) / close.sum(axis=1)[:, None]
    agreement = (mean * out).sum(axis=1) / np.maximum(np.square(out).sum(axis=1), 1e-18)
    return np.asarray(out * np.clip((agreement - _SPLIT) / (_WHOLE - _SPLIT), 0, 1)[:, None])


def normal_weighted_distances(
    points: Array, out: Array, segments: BoneSegments, distances: Array, floor: float
) -> Array:
    """Distances (N, B) float32, up to a thousand times larger where the bone lies in front of the splat.

    d / ((cos + 1) / 2) as in Blender's bone heat, where cos is of the angle between the outward normal and the
    direction from the bone's closest point; the plain distance where the bone lies straight behind the splat.

    points (N, 3); out (N, 3): see `outward_normals`; distances (N, S) to the segments, through the body, any unit;
    floor: lower bound of the distances, in that unit.
    """
    far = np.empty_like(distances, np.float32)
    for column, (start, end) in enumerate(zip(segments.starts, segments.ends, strict=True)):
        way = points - closest_on_segment(points, start, end)
        cosine = np.einsum("nk,nk->n", way, out) / np.maximum(np.linalg.norm(way, axis=1), 1e-30)
        far[:, column] = np.maximum(distances[:, column], floor) / (0.5 * (cosine + 1.001))
    return segments.nearest(far)
