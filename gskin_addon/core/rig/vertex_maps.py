# SPDX-License-Identifier: GPL-3.0-or-later
"""How a mesh deforms around each vertex: linear maps of one-rings, and their rotation and shear (Gao et al. 2024).

T_v = (sum c e' e^T) (sum c e e^T)^-1 over the edges e at v, cotangent weights c, posed edges e'. A flat ring says
nothing about its normal's direction, so every triangle at v adds the pair (s n, s r n') of its normals, s the mean
edge length at v, shared among them, and r the square root of how much the ring's area grew: what is scaled is
scaled along its normal, too. T_v is linear in posed edges and normals, so its coefficients are computed once per mesh.
numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .quaternion import nearest_rotation
from .triangles import THINNEST, triangle_quality

Array = NDArray[Any]

COTANGENTS = (0.02, 50.0)
"""Least and largest cotangent: obtuse angles would give negative weights, slivers endless ones."""

FLAT = 1e-3
"""Least part of the largest eigenvalue of a ring's edges at which they alone tell what happens along its normal."""


@dataclass(frozen=True, eq=False)
class Rings:
    """What `ring_maps` needs of a mesh at rest, per corner of its F triangles.

    coefficients: (F, 3, 3, 3) float64. G[f, k] holds what corner k of triangle f adds to T of its vertex: the edge to
                  the next corner times G[f, k, 0]^T, the edge to the one before times G[f, k, 1]^T, the normal, r long,
                  times G[f, k, 2]^T. Zero for triangles too thin to know (`THINNEST`).
    shares:       (F, 3) float64 one over the doubled area of the ring of the corner's vertex: the posed triangles'
                  doubled areas times these, summed at a vertex, are r^2. Zero for triangles too thin.
    """

    coefficients: Array
    shares: Array


def rest_rings(verts: Array, faces: Array, *, edges_only: bool = False) -> Rings:
    """The rings of a checked mesh (V, 3), (F, 3) at rest.

    edges_only: the least squares of the edges alone (Gao et al. 2024); the normals then count only where the ring is
    too flat for that (`FLAT`).
    """
    corner = np.asarray(verts, dtype=np.float64)[faces]
    solid = triangle_quality(verts, faces) > THINNEST
    to_next = np.roll(corner, -1, axis=1) - corner
    to_last = np.roll(corner, 1, axis=1) - corner
    across = np.cross(to_next[:, 0], to_last[:, 0])
    double = np.linalg.norm(across, axis=1)
    normal = across / np.where(solid, double, 1)[:, None]
    cotangent = np.einsum("fki,fki->fk", to_next, to_last) / np.where(solid, double, 1)[:, None]
    cotangent = np.clip(cotangent, *COTANGENTS) / 2
    # The edge from k to k + 1 lies opposite to k + 2.
    weight_next, weight_last = np.roll(cotangent, -2, axis=1), np.roll(cotangent, -1, axis=1)

    count = len(verts)
    flat = faces[solid].ravel()
    shares = np.bincount(flat, minlength=count)
    lengths = (np.linalg.norm(to_next, axis=2) + np.linalg.norm(to_last, axis=2)) / 2
    mean_edge = np.bincount(flat, lengths[solid].ravel(), count) / np.maximum(shares, 1)
    normal_weight = (mean_edge**2 / np.maximum(shares, 1))[faces]

    of_edges = (
        weight_next[..., None, None] * to_next[..., :, None] * to_next[..., None, :]
        + weight_last[..., None, None] * to_last[..., :, None] * to_last[..., None, :]
    )
    if edges_only:
        values = np.linalg.eigvalsh(_sum_at(flat, of_edges[solid].reshape(-1, 9), count).reshape(-1, 3, 3))
        normal_weight = normal_weight * (values[:, 0] <= FLAT * values[:, 2])[faces]
    gram = of_edges + (
        normal_weight[..., None, None] * (normal[:, :, None] * normal[:, None, :])[:, None]
    )
    matrix = _sum_at(flat, gram[solid].reshape(-1, 9), count).reshape(-1, 3, 3)
    matrix[shares == 0] = np.eye(3)
    area = np.bincount(flat, np.repeat(double[solid], 3), count)
    ring_shares = solid[:, None] / np.where(area > 0, area, 1)[faces]
    inverse = np.linalg.inv(matrix)[faces]
    rows = np.stack(
        [
            weight_next[..., None] * to_next,
            weight_last[..., None] * to_last,
            normal_weight[..., None] * normal[:, None],
        ],
        axis=2,
    )
    coefficients = np.einsum("fkab,fkcb->fkca", inverse, rows) * solid[:, None, None, None]
    return Rings(coefficients, ring_shares)


def ring_maps(posed: Array, faces: Array, rings: Rings) -> Array:
    """T (V, 3, 3) of posed vertices (V, 3); the identity where no triangle tells."""
    posed = np.asarray(posed, dtype=np.float64)
    corner = posed[faces]
    to_next = np.roll(corner, -1, axis=1) - corner
    to_last = np.roll(corner, 1, axis=1) - corner
    across = np.cross(to_next[:, 0], to_last[:, 0])
    double = np.linalg.norm(across, axis=1)
    normal = np.where(double[:, None] > 0, across / np.where(double > 0, double, 1)[:, None], 0)
    growth = np.bincount(faces.ravel(), (double[:, None] * rings.shares).ravel(), len(posed))
    thick = np.sqrt(growth)[faces][..., None] * normal[:, None]
    seen = np.stack([to_next, to_last, thick], axis=2)
    added = np.einsum("fkca,fkcb->fkab", seen, rings.coefficients).reshape(-1, 9)
    maps = _sum_at(faces.ravel(), added, len(posed)).reshape(-1, 3, 3)
    known = np.zeros(len(posed), dtype=bool)
    known[faces[rings.shares.any(axis=1)]] = True
    maps[~known] = np.eye(3)
    return maps


def polar(maps: Array) -> tuple[Array, Array]:
    """Rotation R and symmetric S (..., 3, 3) with T = R S; R is proper, so S of a mirrored T is not positive."""
    rotation = nearest_rotation(maps)
    shear = np.swapaxes(rotation, -1, -2) @ maps
    return rotation, (shear + np.swapaxes(shear, -1, -2)) / 2


def vertex_transforms(
    verts: Array, posed_verts: Array, faces: Array, *, edges_only: bool = False
) -> tuple[Array, Array]:
    """Rotation R and shear S, each (V, 3, 3), of every vertex from rest (V, 3) to pose (V, 3): T_v = R S.

    For a rigid motion R is its rotation and S the identity, for one of another size S is that size; a vertex of no
    (solid) triangle has both the identity. A stretch within a flat ring is found exactly; along its normal the stretch
    is the square root of the area's. edges_only: see `rest_rings`.
    """
    return polar(ring_maps(posed_verts, faces, rest_rings(verts, faces, edges_only=edges_only)))


def mesh_edges(faces: Array) -> Array:
    """(E, 2) distinct edges, smaller index first, in order."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1).astype(np.int64)
    # As single numbers: rows would be compared one by one, with Python's lock held, while Blender waits.
    count = int(pairs.max(initial=0)) + 1
    return np.stack(np.divmod(np.unique(pairs[:, 0] * count + pairs[:, 1]), count), axis=1)


def mesh_neighbours(count: int, faces: Array, most: int = 30) -> Array:
    """(V, K) neighbours of every vertex along edges, padded with the vertex itself.

    K is the largest number of neighbours, at most `most`; of more, the first by index are kept.
    """
    edges = mesh_edges(faces)
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    degree = np.bincount(both[:, 0], minlength=count)
    slot = np.arange(len(both)) - np.repeat(np.cumsum(degree) - degree, degree)
    width = max(1, min(most, int(degree.max(initial=0))))
    table = np.repeat(np.arange(count)[:, None], width, axis=1)
    kept = slot < width
    table[both[kept, 0], slot[kept]] = both[kept, 1]
    return table


def _sum_at(index: Array, values: Array, count: int) -> Array:
    """Rows of `values` (M, k) summed by `index` (M,) -> (count, k)."""
    return np.stack([np.bincount(index, values[:, k], count) for k in range(values.shape[1])], axis=1)
