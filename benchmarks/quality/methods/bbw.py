# SPDX-License-Identifier: GPL-3.0-or-later
"""Bounded biharmonic weights (Jacobson et al. 2011) on a tetrahedral lattice in the filled splats.

Every solid voxel is cut into six tetrahedra (Kuhn), so that no mesher is needed and no shape is refused. libigl's
active set solves the quadratic programs (MPL-2.0; its tetrahedraliser would be AGPL).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from gskin_addon.core.rig.segments import bone_segments, segment_distance
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.voxels import voxelize

from .base import Method, MethodInput, MethodResult, complete

Array = NDArray[Any]

RESOLUTIONS = (56, 48, 40, 34, 28, 24)
"""Voxels along the longest side: the first that gives at most `MOST_NODES` nodes, or the last."""

MOST_NODES = 5000
STEPS = 12
"""Of the active set: it settles after about 8."""

LIMIT = 120.0

_TIE = 1e-6

_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))


@dataclass(frozen=True)
class Lattice:
    """nodes (V, 3) world positions; tets (T, 4); cells (C, 3) solid voxels; corner (C, 8) their nodes, in the order
    of (0, 0, 0), (0, 0, 1), .. (1, 1, 1); origin (3,) and pitch of the voxels."""

    nodes: Array
    tets: Array
    cells: Array
    corner: Array
    origin: Array
    pitch: float


def lattice(solid: Array, origin: Array, pitch: float) -> Lattice:
    """The tetrahedra that fill the voxels of `solid` (X, Y, Z) bool."""
    cells = np.argwhere(solid)
    shape = np.array(solid.shape) + 1
    flat = np.ravel_multi_index(tuple((cells[:, None] + _CORNERS).reshape(-1, 3).T), tuple(shape))
    used, corner = np.unique(flat, return_inverse=True)
    corner = corner.reshape(-1, 8)
    nodes = np.stack(np.unravel_index(used, tuple(shape)), axis=1) * pitch + origin
    # Kuhn's subdivision: from (0, 0, 0) to (1, 1, 1) along the axes in each of the six orders.
    tets = []
    for first, second, _ in itertools.permutations((4, 2, 1)):
        tets.append(corner[:, [0, first, first + second, 7]])
    all_tets = np.concatenate(tets)
    edges = nodes[all_tets[:, 1:]] - nodes[all_tets[:, :1]]
    turned = np.linalg.det(edges) < 0
    all_tets[turned] = all_tets[turned][:, [0, 2, 1, 3]]
    return Lattice(nodes, all_tets, cells, corner, np.asarray(origin, np.float64), pitch)


def handles(nodes: Array, skeleton: Skeleton, pitch: float) -> Array:
    """Which bone holds each node (V,), -1 for free: the nodes along the bones, each by the bone nearest to it.

    A node at a joint, as near to another bone, stays free unless a bone has no other. A bone outside the domain
    holds the one node that is nearest to it. Several short bones at one node: only one of them gets it.
    """
    tree = cKDTree(nodes)
    near: list[dict[int, float]] = [{} for _ in range(skeleton.count)]
    segments = bone_segments(skeleton)
    for start, end, bone in zip(segments.starts, segments.ends, segments.bone, strict=True):
        steps = int(np.linalg.norm(end - start) / (0.5 * pitch)) + 2
        distance, node = tree.query(start + np.linspace(0, 1, steps)[:, None] * (end - start))
        node = np.unique(node[(distance <= pitch) | (distance == distance.min())])
        exact = segment_distance(nodes[node], start, end)
        for n, d in zip(node.tolist(), exact.tolist(), strict=True):
            near[bone][n] = min(d, near[bone].get(n, np.inf))
    best, held = np.full(len(nodes), np.inf), np.full(len(nodes), -1)
    contested = np.zeros(len(nodes), bool)
    for bone, found in enumerate(near):
        for n, d in found.items():
            if abs(d - best[n]) <= _TIE * pitch:
                contested[n] = True
            elif d < best[n]:
                best[n], held[n], contested[n] = d, bone, False
    held[contested] = -1
    for bone, found in enumerate(near):
        free = [n for n in found if held[n] < 0]
        if free and not (held == bone).any():
            held[min(free, key=lambda n: found[n])] = bone
    return held


def bounded_biharmonic(mesh: Lattice, held: Array, bones: int) -> Array:
    """Weights (V, B), rows sum to 1, from the nodes that bones hold (V,); zeros in parts that no bone reaches."""
    import igl

    reached = _reached(mesh, held)
    new = np.cumsum(reached) - 1
    tets = np.ascontiguousarray(new[mesh.tets[reached[mesh.tets[:, 0]]]].astype(np.int64))
    nodes = mesh.nodes[reached] / float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
    known = np.flatnonzero(held >= 0)
    # A bone without any node would get the solution zero: leave it out of the program.
    used = np.unique(held[known])
    values = (held[known][:, None] == used[None]).astype(np.float64)
    weights = np.zeros((len(held), bones))
    if len(used) == 1:
        weights[reached, used[0]] = 1
        return weights
    found = igl.bbw(np.ascontiguousarray(nodes), tets, new[known].astype(np.int64), values, max_iter=STEPS)
    found = np.clip(found, 0, 1)
    total = found.sum(axis=1, keepdims=True)
    weights[np.ix_(np.flatnonzero(reached), used)] = found / np.where(total > 0, total, 1)
    return weights


def _reached(mesh: Lattice, held: Array) -> NDArray[np.bool_]:
    """(V,) whether a node hangs together with one that a bone holds."""
    count = len(mesh.nodes)
    a, b = mesh.tets[:, [0, 0, 0]].ravel(), mesh.tets[:, 1:].ravel()
    part = sparse.csgraph.connected_components(sparse.coo_matrix((np.ones(len(a)), (a, b)), (count, count)), False)[1]
    return np.isin(part, part[held >= 0])


def interpolate(mesh: Lattice, values: Array, points: Array) -> Array:
    """Values (N, C) at points, trilinear in the solid voxel nearest to each, from those of the nodes (V, C)."""
    _, cell = cKDTree((mesh.cells + 0.5) * mesh.pitch + mesh.origin).query(points)
    inside = np.clip((points - mesh.origin) / mesh.pitch - mesh.cells[cell], 0, 1)
    share = np.where(_CORNERS[None], inside[:, None], 1 - inside[:, None]).prod(axis=2)
    return np.asarray(np.einsum("nk,nkc->nc", share, values[mesh.corner[cell]]))


def create(name: str) -> Method:
    """The method."""
    return Method(make, LIMIT)


def make(subject: MethodInput) -> MethodResult:
    """Weights of the lattice at the splats."""
    cloud, skeleton = subject.cloud, subject.skeleton
    for resolution in RESOLUTIONS:
        grid = voxelize(cloud.means, cloud.opacities, resolution, scales=cloud.scales, quats=cloud.quats)
        mesh = lattice(grid.solid, grid.origin, grid.pitch)
        if len(mesh.nodes) <= MOST_NODES:
            break
    held = handles(mesh.nodes, skeleton, grid.pitch)
    found = bounded_biharmonic(mesh, held, skeleton.count)
    weights, bare = complete(interpolate(mesh, found, cloud.means), cloud.means, skeleton)
    idle = skeleton.count - len(np.unique(held[held >= 0]))
    notes = [f"{len(mesh.nodes)} nodes"]
    if idle:
        notes.append(f"{idle} of {skeleton.count} bones too close to others for the lattice")
    if bare:
        notes.append(f"no weights: {bare} of {cloud.count} splats in parts without bones follow their nearest bone")
    return MethodResult(weights, "; ".join(notes), bare > 0)
