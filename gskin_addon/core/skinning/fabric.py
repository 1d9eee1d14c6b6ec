# SPDX-License-Identifier: GPL-3.0-or-later
"""A fabric of triangles between neighbouring splats, so that tools for meshes work on splats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.nearest_points import nearest_points
from ..splats.cloud import SplatCloud
from ..ticks import Tick, silent
from .normal_weighted_distance import outward_normals, surface_normals
from .voxels import voxelize
from .walls import blocked

Array = NDArray[Any]

NEIGHBOURS = 6
"""Of these each splat makes a fan; with 4 the fabric has holes."""
_AROUND = 12  # splats that tell where the surface runs
_WIDEST = np.radians(150)  # of an angle in a fan; wider ones are where the surface ends
_REACH = 3.0  # times the usual way to the last neighbour: further is across a gap
_PASSES = 4  # of neighbours telling the doubtful which side is out


@dataclass(frozen=True, eq=False)
class Fabric:
    """triangles (T, 3) int32: splats, counter-clockwise seen from outside; edges (E, 2) int32: their sides, each once,
    the lower splat first; sides (T, 3) int32: the edge from each corner of a triangle to the next."""

    triangles: Array
    edges: Array
    sides: Array

    @classmethod
    def of(cls, triangles: Array) -> Fabric:
        """The fabric of triangles (T, 3)."""
        one = triangles.astype(np.int64)
        other = np.roll(one, -1, axis=1)
        count = int(one.max(initial=0)) + 1
        key = np.minimum(one, other) * count + np.maximum(one, other)
        key, side = np.unique(key.ravel(), return_inverse=True)
        edges = np.stack(np.divmod(key, count), axis=1)
        return cls(triangles.astype(np.int32), edges.astype(np.int32), side.reshape(one.shape).astype(np.int32))


def fabric_triangles(
    cloud: SplatCloud, *, walls: Array | None = None, apart: tuple[Array, Array] | None = None, tick: Tick = silent
) -> Array:
    """Triangles (T, 3) int32 of splats, counter-clockwise seen from outside, each once.

    Every splat makes a fan of the `NEIGHBOURS` splats nearest to it, in the order in which they lie around it on the
    surface. There is no triangle across gaps, none over walls (N,), see `walls`, and none between splats whose bones
    have nothing to do with one another: apart is each splat's bone (N,) and which bones are far from which (B, B) bool.
    """
    points = np.asarray(cloud.means, np.float64)
    if len(points) < 3:
        return np.zeros((0, 3), np.int32)
    k = min(_AROUND, len(points))
    way, near = nearest_points(points, points, k)
    tick(0.3)
    out = _outward(cloud, points, near)
    tick(0.6)
    own = np.arange(len(points))
    # Of splats on one another, another may come first; whichever is itself goes to the end.
    itself = near == own[:, None]
    order = np.argsort(itself, axis=1, kind="stable")[:, : min(NEIGHBOURS, k - 1)]
    beside, length = np.take_along_axis(near, order, 1), np.take_along_axis(way, order, 1)
    reach = _REACH * float(np.median(length[:, -1]))

    along = _tangents(out)
    offset = points[beside] - points[:, None]
    angle = np.arctan2(*(np.einsum("nki,ni->nk", offset, axis) for axis in (along[1], along[0])))
    angle[length > reach] = np.inf  # they come last, and make no triangle
    turn = np.argsort(angle, axis=1, kind="stable")
    beside, angle = np.take_along_axis(beside, turn, 1), np.take_along_axis(angle, turn, 1)
    following = np.roll(np.arange(beside.shape[1]), -1)
    # The last that counts is followed by the first.
    count = np.isfinite(angle).sum(axis=1)
    successor = np.where(np.arange(beside.shape[1])[None] + 1 < count[:, None], following[None], 0)
    b, c = beside, np.take_along_axis(beside, successor, 1)
    with np.errstate(invalid="ignore"):
        gap = np.mod(np.take_along_axis(angle, successor, 1) - angle, 2 * np.pi)
        good = np.isfinite(gap) & (gap > 0) & (gap < _WIDEST)
    a = np.broadcast_to(own[:, None], b.shape)
    triangles = np.stack([a[good], b[good], c[good]], axis=1)
    tick(0.7)
    triangles = _without_webs(points, triangles, reach, walls, apart)
    triangles = _each_once(triangles)
    tick(0.9)
    corner = points[triangles]
    facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = np.einsum("ti,ti->t", facing, out[triangles].sum(axis=1)) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return triangles.astype(np.int32)


def _outward(cloud: SplatCloud, points: Array, near: Array) -> Array:
    """(N, 3) unit normals that point out of the body; the doubtful follow those around them."""
    normals = surface_normals(points, _AROUND, near)
    grid = voxelize(cloud.means, cloud.opacities, scales=cloud.scales, quats=cloud.quats)
    sure = outward_normals(points, normals, grid)
    for _ in range(_PASSES):
        sure = 0.5 * sure + 0.5 * sure[near].mean(axis=1)
    side = np.einsum("nk,nk->n", sure, normals)
    return np.asarray(normals * np.where(side < 0, -1.0, 1.0)[:, None])


def _tangents(normals: Array) -> tuple[Array, Array]:
    """Two unit vectors (N, 3) across each normal, right-handed with it."""
    axis = np.zeros_like(normals)
    axis[np.arange(len(normals)), np.abs(normals).argmin(axis=1)] = 1
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)


def _without_webs(
    points: Array, triangles: Array, reach: float, walls: Array | None, apart: tuple[Array, Array] | None
) -> Array:
    keep = np.ones(len(triangles), bool)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        one, other = triangles[:, i], triangles[:, j]
        way = points[one] - points[other]
        square = np.einsum("ti,ti->t", way, way)
        keep &= (square <= reach**2) & (square > 0)
        if walls is not None:
            keep &= ~blocked(walls[one], walls[other])
        if apart is not None:
            bone, far = apart
            keep &= ~far[bone[one], bone[other]]
    return np.asarray(triangles[keep])


def _each_once(triangles: Array) -> Array:
    """Three splats make at most one triangle."""
    ordered = np.sort(triangles, axis=1).astype(np.int64)
    ordered = ordered[(ordered[:, 0] != ordered[:, 1]) & (ordered[:, 1] != ordered[:, 2])]
    # One number for each: numpy sorts rows as such with Python's lock held, and Blender would stand still.
    count = int(ordered.max(initial=0)) + 1
    pairs, pair = np.unique(ordered[:, 0] * count + ordered[:, 1], return_inverse=True)
    key, third = np.divmod(np.unique(pair.reshape(-1) * count + ordered[:, 2]), count)
    return np.stack([*np.divmod(pairs[key], count), third], axis=1)
