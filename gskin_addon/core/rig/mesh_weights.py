# SPDX-License-Identifier: GPL-3.0-or-later
"""Skinning weights between a proxy mesh's vertices and the splats anchored to it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .anchoring import Anchors
from .vertex_maps import mesh_edges

Array = NDArray[Any]


def splat_weights(anchors: Anchors, vertex_weights: Array, faces: Array) -> Array:
    """Weights (N, B) of the splats: those of their triangle's vertices (V, B), blended by the barycentrics."""
    weights = np.asarray(vertex_weights)
    triangles = np.asarray(faces)[anchors.face]
    out = np.zeros((anchors.count, weights.shape[1]), dtype=weights.dtype)
    for k in range(3):
        out += anchors.bary[:, k : k + 1].astype(weights.dtype) * weights[triangles[:, k]]
    return out


def anchor_matrix(anchors: Anchors, faces: Array, count: int) -> Any:
    """The same blend as a scipy CSR matrix (N, V) for a mesh of `count` vertices; rows sum to 1."""
    from scipy import sparse

    columns = np.asarray(faces)[anchors.face].ravel()
    rows = np.repeat(np.arange(anchors.count), 3)
    return sparse.csr_matrix((anchors.bary.ravel(), (rows, columns)), shape=(anchors.count, count))


def mesh_weights(anchors: Anchors, weights: Array, faces: Array, count: int, *, smoothness: float = 1e-2) -> Array:
    """Weights (V, B) of the mesh's vertices from those of the splats (N, B), rows sum to 1.

    Least squares: minimises |A W - weights|^2 + smoothness * sum over edges |W_i - W_j|^2, A the
    `anchor_matrix`. The second term decides where splats are few and fills vertices that no splat hangs on;
    a part of the mesh without any splats gets the mean weights. Negative values (the fit may overshoot a little)
    become 0.
    """
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import splu

    target = np.asarray(weights, dtype=np.float64)
    matrix = anchor_matrix(anchors, faces, count)
    edges = mesh_edges(np.asarray(faces))
    # Weighted by the splats per vertex, the balance does not depend on how many there are.
    strength = smoothness * max(anchors.count / max(count, 1), 1e-6)
    adjacency = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    adjacency = (adjacency + adjacency.T).tocsr()
    laplacian = sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
    _, part = connected_components(adjacency, directed=False)
    held = np.bincount(part, np.asarray(matrix.sum(axis=0)).ravel()) > 0
    lost = ~held[part]
    normal = matrix.T @ matrix + strength * laplacian + sparse.diags(lost.astype(np.float64) + 1e-9)
    right = matrix.T @ target
    right[lost] = target.mean(axis=0)
    out = np.maximum(splu(normal.tocsc()).solve(right), 0)
    return (out / np.maximum(out.sum(axis=1, keepdims=True), 1e-30)).astype(np.asarray(weights).dtype)
