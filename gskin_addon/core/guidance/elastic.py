# SPDX-License-Identifier: GPL-3.0-or-later
"""Elastic posing: an as-rigid-as-possible deformation of the splats' neighbour graph, bones as handles.

Needs no weights and no training: it knows only that neighbouring splats should stay neighbours and that
a splat near a bone should follow it. After Sorkine & Alexa 2007; the strength of the handles is that of
bone heat (Baran & Popovic 2007).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..render.rasterizer import render_cloud
from ..rig.lbs import skin_points
from ..rig.quaternion import matrix_to_quat, normalize, quat_multiply
from ..rig.segments import bone_segments
from ..skinning.heat import CLOSEST, NORMAL_WEIGHTED_STRENGTH, BoneHeat, diagonal
from ..skinning.normal_weighted_distance import (
    consistent_normals,
    normal_weighted_distances,
    outward_normals,
    surface_normals,
)
from ..skinning.rotations import closest_rotation
from ..skinning.voxels import voxelize
from ..splats.cloud import SplatCloud
from .control import ControlSignal
from .provider import GuidanceContext, to_bytes

ITERATIONS = 3


class ElasticBody:
    """The splats as an elastic body that is held by its bones.

    Minimises over the nodes' positions x'
        sum_edges |(x'_i - x'_j) - R_i (x_i - x_j)|^2 + sum_i h_i |x'_i - P_b(i) x_i|^2,
    with the handles b(i), h_i of `heat`, whose equilibrium is the first guess of a pose.
    """

    def __init__(self, cloud: SplatCloud, heat: BoneHeat) -> None:
        """cloud: N splats; heat: on the same."""
        from scipy import sparse
        from scipy.sparse.linalg import splu

        self.cloud, self._heat = cloud, heat
        a, b = heat.graph.edges.T
        count = len(heat.rest)
        one_way = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
        self._adjacency = (one_way + one_way.T).tocsr()
        degree = np.asarray(self._adjacency.sum(axis=1)).ravel()
        # Many poses are solved with one matrix: factorising it pays, unlike for the heat.
        self._solver = splu((sparse.diags(degree + heat.handle_strength) - self._adjacency).tocsc())

    def pose(self, transforms: NDArray[Any]) -> Iterator[SplatCloud]:
        """The cloud in each pose of transforms (P, B, 4, 4)."""
        transforms = np.asarray(transforms, np.float64)
        heat, rest = self._heat, self._heat.rest
        goal = skin_points(rest, heat.handle_bone, transforms)
        posed = skin_points(rest, heat.equilibrium, transforms)
        rotations = np.empty((*posed.shape[:2], 3, 3))
        pull = np.empty_like(posed)
        graph = self._adjacency
        for _ in range(ITERATIONS):
            _local_rotations(rest, posed, graph.indptr, graph.indices, rotations)
            _turned_edges(rest, rotations, graph.indptr, graph.indices, pull)
            pull += heat.handle_strength[:, None] * goal
            flat = pull.transpose(1, 0, 2).reshape(len(rest), -1)
            solved = self._solver.solve(flat).reshape(len(rest), len(transforms), 3)
            posed = np.ascontiguousarray(solved.transpose(1, 0, 2))
        _local_rotations(rest, posed, graph.indptr, graph.indices, rotations)
        for position, rotation in zip(posed, rotations, strict=True):
            yield self._carry(position, rotation)

    def _carry(self, posed: NDArray[np.float64], rotation: NDArray[np.float64]) -> SplatCloud:
        """Splats follow the rigid motions of their nodes, blended (embedded deformation, Sumner 2007)."""
        graph, means, rest = self._heat.graph, self.cloud.means, self._heat.rest
        offset = means[:, None, :] - rest[graph.anchor]
        moved = np.einsum("nkij,nkj->nki", rotation[graph.anchor], offset) + posed[graph.anchor]
        turn = matrix_to_quat(rotation)[graph.anchor]
        turn *= np.where((turn * turn[:, :1]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
        blended = normalize(np.einsum("nk,nkq->nq", graph.anchor_weight, turn))
        return replace(
            self.cloud,
            means=np.einsum("nk,nkd->nd", graph.anchor_weight, moved).astype(np.float32),
            quats=normalize(quat_multiply(blended, self.cloud.quats)).astype(np.float32),
        )


@njit(cache=True, parallel=True)
def _local_rotations(rest, posed, pointer, index, out):  # type: ignore[no-untyped-def]
    """out (P, M, 3, 3): the rotation that best takes each node's rest edges to its posed ones."""
    poses, count = posed.shape[0], posed.shape[1]
    for work in prange(poses * count):
        p, j = work // count, work % count
        S = np.zeros((3, 3))
        for e in range(pointer[j], pointer[j + 1]):
            k = index[e]
            for a in range(3):
                d = posed[p, k, a] - posed[p, j, a]
                for b in range(3):
                    S[a, b] += d * (rest[k, b] - rest[j, b])
        closest_rotation(S, out[p, j])


@njit(cache=True, parallel=True)
def _turned_edges(rest, rotations, pointer, index, out):  # type: ignore[no-untyped-def]
    """out (P, M, 3): right-hand side of the global step, sum_j (R_i + R_j) / 2 (x_i - x_j)."""
    poses, count = rotations.shape[0], rotations.shape[1]
    for work in prange(poses * count):
        p, j = work // count, work % count
        for a in range(3):
            out[p, j, a] = 0.0
        for e in range(pointer[j], pointer[j + 1]):
            k = index[e]
            for a in range(3):
                for b in range(3):
                    both = 0.5 * (rotations[p, j, a, b] + rotations[p, k, a, b])
                    out[p, j, a] += both * (rest[j, b] - rest[k, b])


class ElasticGuidance:
    """Renders the elastic body in each pose; no weights, no training, no download."""

    BATCH = 8

    def __init__(self, context: GuidanceContext) -> None:
        heat = BoneHeat(
            context.cloud,
            context.distances,
            handle_distances=_handle_distances(context),
            strength=NORMAL_WEIGHTED_STRENGTH,
        )
        self.body = ElasticBody(context.cloud, heat)
        self._background = context.background

    def images(self, signals: Sequence[ControlSignal]) -> Iterator[NDArray[np.uint8]]:
        """See Provider; poses are solved `BATCH` at a time, on one factorisation."""
        for first in range(0, len(signals), self.BATCH):
            batch = signals[first : first + self.BATCH]
            posed = self.body.pose(np.stack([signal.transforms for signal in batch]))
            for signal, cloud in zip(batch, posed, strict=True):
                yield to_bytes(render_cloud(cloud, signal.camera, self._background)[0])


def _handle_distances(context: GuidanceContext) -> NDArray[Any]:
    """Distances (N, B) for the handles: bones behind a splat's surface hold it, those in front of it hardly do."""
    cloud, segments = context.cloud, bone_segments(context.skeleton)
    grid = voxelize(cloud.means, cloud.opacities, scales=cloud.scales, quats=cloud.quats)
    points = cloud.means.astype(np.float64)
    size = diagonal(cloud)
    distances = np.asarray(context.distances)
    out = outward_normals(points, surface_normals(points), grid)
    out = consistent_normals(points, out, distances.min(axis=1), size)
    return normal_weighted_distances(points, out, segments, distances[:, segments.bone], CLOSEST * size)


def create(context: GuidanceContext) -> ElasticGuidance:
    """The provider for `context`."""
    return ElasticGuidance(context)
