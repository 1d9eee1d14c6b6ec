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
from ..rig.rotations import closest_rotation
from ..rig.segments import bone_segments
from ..skinning.facing import agreed, facing_distances, outward, surface_normals
from ..skinning.voxels import voxelize
from ..splats.cloud import SplatCloud
from .control import ControlSignal
from .graph import NodeGraph, build_graph
from .provider import GuidanceContext, to_bytes

HANDLE_STRENGTH = 3.0
FACING_STRENGTH = 6.0
"""Of handles that feel `facing_distances`: with 4, 6 and 9 the heat weights keep 0.659, 0.641 and 0.641 of the initial
weights' error on 83 assets, and on the animals among them 0.577, 0.584 and 0.599."""

ITERATIONS = 3
TIES = 1.0001
CLOSEST = 1e-3
"""Distances below this share of the diagonal count as this."""


class ElasticBody:
    """The splats as an elastic body that hangs on its bones.

    Minimises over the nodes' positions x'
        sum_edges |(x'_i - x'_j) - R_i (x_i - x_j)|^2 + sum_i h_i |x'_i - P_b(i) x_i|^2,
    with h_i = strength m_i / d_i^2: d_i is the distance to the nearest bone b(i), m_i a quarter of
    the summed squared edges, which makes the balance independent of how densely the nodes lie. The handles
    close to their bone are thereby firm, the doubtful ones far from all bones are carried by their
    neighbours.
    """

    def __init__(
        self,
        cloud: SplatCloud,
        distances: NDArray[Any],
        *,
        reach: NDArray[Any] | None = None,
        strength: float = HANDLE_STRENGTH,
        nodes: int = 3000,
    ) -> None:
        """cloud: N splats; distances (N, B): from each splat to each bone, through the body, metres; reach (N, B):
        the same as the handles feel it, such as `facing_distances`; strength of the handles."""
        from scipy import sparse
        from scipy.sparse.linalg import splu

        self.cloud = cloud
        self.graph: NodeGraph = build_graph(cloud.means, distances, nodes)
        self._rest = cloud.means[self.graph.nodes].astype(np.float64)
        a, b = self.graph.edges.T
        count = len(self._rest)
        square = np.square(self._rest[a] - self._rest[b]).sum(1)
        square = np.minimum(square, 4 * np.median(square))  # bridges across gaps are no measure of density
        mass = (np.bincount(a, square, count) + np.bincount(b, square, count)) / 4
        felt = distances if reach is None else reach
        near = np.maximum(np.asarray(felt[self.graph.nodes], np.float64), CLOSEST * _diagonal(cloud))
        nearest = near.min(axis=1, keepdims=True)
        self._bone = near <= nearest * TIES
        self._bone = self._bone / self._bone.sum(axis=1, keepdims=True)
        self._strength = strength * mass / nearest[:, 0] ** 2
        adjacency = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
        self._adjacency = (adjacency + adjacency.T).tocsr()
        degree = np.asarray(self._adjacency.sum(axis=1)).ravel()
        self._laplacian = sparse.diags(degree) - self._adjacency
        self._solver = splu((self._laplacian + sparse.diags(self._strength)).tocsc())
        # Heat equilibrium: the weights that the handles spread over the graph; the first guess of a pose.
        self._heat = self._solver.solve(self._strength[:, None] * self._bone)

    def weights(self, strength: float = 1.0) -> NDArray[np.float32]:
        """The heat-equilibrium weights (N, B) of the splats, rows sum to 1.

        Handles of another `strength`, as a part of the usual one, give wider (below 1) or narrower transitions.
        """
        from scipy import sparse
        from scipy.sparse.linalg import splu

        heat = self._heat
        if strength != 1.0:
            handles = strength * self._strength
            heat = splu((self._laplacian + sparse.diags(handles)).tocsc()).solve(handles[:, None] * self._bone)
        spread = np.einsum("nk,nkb->nb", self.graph.anchor_weight, heat[self.graph.anchor])
        spread = np.maximum(spread, 0)
        return (spread / spread.sum(axis=1, keepdims=True)).astype(np.float32)

    def pose(self, transforms: NDArray[Any]) -> Iterator[SplatCloud]:
        """The cloud in each pose of transforms (P, B, 4, 4)."""
        transforms = np.asarray(transforms, np.float64)
        goal = skin_points(self._rest, self._bone, transforms)
        posed = skin_points(self._rest, self._heat, transforms)
        rotations = np.empty((*posed.shape[:2], 3, 3))
        pull = np.empty_like(posed)
        graph = self._adjacency
        for _ in range(ITERATIONS):
            _local_rotations(self._rest, posed, graph.indptr, graph.indices, rotations)
            _turned_edges(self._rest, rotations, graph.indptr, graph.indices, pull)
            pull += self._strength[:, None] * goal
            flat = pull.transpose(1, 0, 2).reshape(len(self._rest), -1)
            solved = self._solver.solve(flat).reshape(len(self._rest), len(transforms), 3)
            posed = np.ascontiguousarray(solved.transpose(1, 0, 2))
        _local_rotations(self._rest, posed, graph.indptr, graph.indices, rotations)
        for position, rotation in zip(posed, rotations, strict=True):
            yield self._carry(position, rotation)

    def _carry(self, posed: NDArray[np.float64], rotation: NDArray[np.float64]) -> SplatCloud:
        """Splats follow the rigid motions of their nodes, blended (embedded deformation, Sumner 2007)."""
        graph, means = self.graph, self.cloud.means
        offset = means[:, None, :] - self._rest[graph.anchor]
        moved = np.einsum("nkij,nkj->nki", rotation[graph.anchor], offset) + posed[graph.anchor]
        turn = matrix_to_quat(rotation)[graph.anchor]
        turn *= np.where((turn * turn[:, :1]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
        blended = normalize(np.einsum("nk,nkq->nq", graph.anchor_weight, turn))
        return replace(
            self.cloud,
            means=np.einsum("nk,nkd->nd", graph.anchor_weight, moved).astype(np.float32),
            quats=normalize(quat_multiply(blended, self.cloud.quats)).astype(np.float32),
        )


def _diagonal(cloud: SplatCloud) -> float:
    lower, upper = cloud.bounds()
    return float(np.linalg.norm(upper - lower))


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
        self.body = ElasticBody(context.cloud, context.distances, reach=_felt(context), strength=FACING_STRENGTH)
        self._background = context.background

    def images(self, signals: Sequence[ControlSignal]) -> Iterator[NDArray[np.uint8]]:
        """See Provider; poses are solved `BATCH` at a time, on one factorisation."""
        for first in range(0, len(signals), self.BATCH):
            batch = signals[first : first + self.BATCH]
            posed = self.body.pose(np.stack([signal.transforms for signal in batch]))
            for signal, cloud in zip(batch, posed, strict=True):
                yield to_bytes(render_cloud(cloud, signal.camera, self._background)[0])


def _felt(context: GuidanceContext) -> NDArray[Any]:
    """Distances (N, B) as the handles feel them: bones behind a splat hold it, those before it hardly do."""
    cloud, segments = context.cloud, bone_segments(context.skeleton)
    grid = voxelize(cloud.means, cloud.opacities, scales=cloud.scales, quats=cloud.quats)
    points = cloud.means.astype(np.float64)
    size = _diagonal(cloud)
    distances = np.asarray(context.distances)
    out = agreed(points, outward(points, surface_normals(points), grid), distances.min(axis=1), size)
    return facing_distances(points, out, segments, distances[:, segments.bone], CLOSEST * size)


def create(context: GuidanceContext) -> ElasticGuidance:
    """The provider for `context`."""
    return ElasticGuidance(context)
