# SPDX-License-Identifier: GPL-3.0-or-later
"""Which way out is, on splats and on meshes: unit directions, shortened to the certainty that one has of their sign."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.nearest_points import nearest_points
from ...splats.cloud import SplatCloud
from ...ticks import Tick, silent
from ..normal_weighted_distance import outward_normals, surface_normals
from ..voxels import voxelize

Array = NDArray[Any]

_AROUND = 12  # splats that tell where the surface runs
_PASSES = 30  # of neighbours telling the doubtful which side is out


def splat_facing(cloud: SplatCloud, tick: Tick = silent) -> Array:
    """(N, 3) directions out of the body at the splats, of a length 0 (inside or outside, nobody knows) to 1.

    The normal is the direction in which a splat's neighbours spread least; outside is what the filled voxels say.
    """
    points = np.asarray(cloud.means, np.float64)
    if len(points) < 3:
        return np.zeros((len(points), 3))
    near = nearest_points(points, points, min(_AROUND, len(points)))[1]
    tick(0.4)
    normals = surface_normals(points, _AROUND, near)
    tick(0.6)
    sure = outward_normals(
        points, normals, voxelize(cloud.means, cloud.opacities, scales=cloud.scales, quats=cloud.quats)
    )
    side = np.clip(np.einsum("nk,nk->n", sure, normals), -1, 1)
    return np.asarray(normals * _told(points, normals, side, near)[:, None])


def _told(points: Array, normals: Array, side: Array, near: Array) -> Array:
    """(N,) the sides that the normals (N, 3) point to, 1 out to -1 in, where the doubtful follow their neighbours.

    Voxels do not know what is out in a narrow gap, but the surface leads into it: neighbours, near (N, K), count by how
    far they lie along it, not across the gap.
    """
    pull = np.zeros(near.shape)
    for k in range(near.shape[1]):
        way = points[near[:, k]] - points
        length = np.linalg.norm(way, axis=1)
        across = np.abs(np.einsum("nk,nk->n", way, normals)) + np.abs(np.einsum("nk,nk->n", way, normals[near[:, k]]))
        along = np.clip(1 - across / np.maximum(length, 1e-30), 0, 1) * (length > 0)
        pull[:, k] = along * np.einsum("nk,nk->n", normals, normals[near[:, k]])
    pull /= np.maximum(np.abs(pull).sum(axis=1, keepdims=True), 1e-12)
    known = np.abs(side)
    out = side.copy()
    for _ in range(_PASSES):
        out = known * side + (1 - known) * (pull * out[near]).sum(axis=1)
    return np.asarray(out)


def vertex_facing(verts: Array, faces: Array) -> Array:
    """(V, 3) normals of a mesh's vertices by its winding, weighted by area; zero where no triangle tells.

    verts (V, 3), faces (F, 3). A mesh that is wound inside out as a whole is turned: its volume is negative.
    """
    corner = np.asarray(verts, np.float64)[faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    out = np.stack([_gathered(faces, across[:, axis], len(verts)) for axis in range(3)], axis=1)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    middle = corner.mean(axis=(0, 1)) if len(corner) else np.zeros(3)
    volume = np.einsum("fk,fk->", corner.mean(axis=1) - middle, across)
    return np.asarray(out / np.where(length > 0, length, 1) * (-1.0 if volume < 0 else 1.0))


def _gathered(faces: Array, values: Array, count: int) -> Array:
    """Values (F,) summed at each of `count` vertices."""
    return np.bincount(np.asarray(faces).ravel(), np.repeat(values, 3), count)
