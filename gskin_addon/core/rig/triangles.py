# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangles of a proxy mesh: checks, frames, circumradii, closest points. numpy only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

Array = NDArray[Any]

THINNEST = 1e-3
"""Least quality of a triangle that carries splats (see `triangle_quality`).

A thinner one has a circumradius far beyond its size and a normal that turns with every tremor. Its
neighbours, at most its width away, take its splats.
"""


def check_mesh(verts: ArrayLike, faces: ArrayLike, label: str = "the proxy mesh") -> tuple[Array, Array]:
    """The mesh as (V, 3) float64 and (F, 3) int64.

    Open, non-manifold and inconsistently wound meshes pass: every formula here works triangle by triangle.

    Raises:
        InputError: no triangles, indices without a vertex, values that are not finite, or no triangle with
            an area worth the name (`THINNEST`).
    """
    points = np.asarray(verts, dtype=np.float64)
    triangles = np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise InputError(
            f"{_sentence(label)} has vertices {points.shape} and faces {triangles.shape}, not triangles in "
            "space; triangulate it and export it again."
        )
    if triangles.dtype.kind not in "iu":
        raise InputError(f"{_sentence(label)} has faces that are not whole numbers; export it again.")
    triangles = triangles.astype(np.int64)
    if len(triangles) == 0:
        raise InputError(f"{_sentence(label)} has no faces; give a mesh with a surface.")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise InputError(f"{_sentence(label)} has faces of vertices that do not exist; export it again.")
    if not np.isfinite(points).all():
        raise InputError(f"{_sentence(label)} has vertices that are not finite; clean it up and try again.")
    if not (triangle_quality(points, triangles) > THINNEST).any():
        raise InputError(
            f"{_sentence(label)} has no triangle with an area; merge its doubled vertices or give another."
        )
    return points, triangles


def triangle_quality(verts: Array, faces: Array) -> Array:
    """(F,) 4 sqrt(3) area / (sum of the squared edges): 1 for an equilateral triangle, 0 for a line."""
    corner = verts[faces]
    edges = np.roll(corner, -1, axis=1) - corner
    double = np.linalg.norm(np.cross(edges[:, 0], -edges[:, 2]), axis=1)
    square = np.square(edges).sum(axis=(1, 2))
    result: Array = 2 * np.sqrt(3) * double / np.where(square > 0, square, 1)
    return result


def face_frames(verts: Array, faces: Array) -> tuple[Array, Array, Array]:
    """An orthonormal frame per triangle, the circumradii, and twice the areas.

    Returns frames (..., F, 3, 3), columns: along the first edge, normal x that, unit normal; circumradii
    (..., F) in the unit of `verts` (..., V, 3); doubled areas (..., F) in its square. A triangle without an area
    (in a pose, say) has a zero normal, so that nothing is offset from it, and a third of its edges' sum as radius.
    """
    corner = verts[..., faces, :]
    first, last = corner[..., 1, :] - corner[..., 0, :], corner[..., 2, :] - corner[..., 0, :]
    across = np.cross(first, last)
    double = np.linalg.norm(across, axis=-1)
    a, b = np.linalg.norm(first, axis=-1), np.linalg.norm(last, axis=-1)
    c = np.linalg.norm(last - first, axis=-1)
    solid = double > 1e-12 * np.maximum(np.maximum(a, b), c) ** 2
    normal = np.where(solid[..., None], across, 0) / np.where(solid, double, 1)[..., None]
    tangent = first / np.where(a > 0, a, 1)[..., None]
    frames = np.stack([tangent, np.cross(normal, tangent), normal], axis=-1)
    radius = np.where(solid, a * b * c / np.where(solid, 2 * double, 1), (a + b + c) / 3)
    return frames, radius, double


def closest_barycentric(points: Array, corner: Array) -> Array:
    """Barycentric coordinates (M, 3) of the points nearest to `points` (M, 3) in triangles (M, 3, 3).

    Non-negative, sum 1. Triangles without an area count as the segments that they are.
    """
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    uw, vw = _dot(u, w), _dot(v, w)
    gram: Array = uu * vv - uv * uv
    flat = gram <= 1e-20 * uu * vv
    gram = np.where(flat, 1, gram)
    second: Array = (vv * uw - uv * vw) / gram
    third: Array = (uu * vw - uv * uw) / gram
    inside = np.stack([1 - second - third, second, third], axis=1)
    outside = flat | (inside < 0).any(axis=1)
    if not outside.any():
        return inside
    corner, points = corner[outside], points[outside]
    best = np.full(len(points), np.inf)
    edge_bary = np.zeros((len(points), 3))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge, to = corner[:, j] - corner[:, i], points - corner[:, i]
        square = _dot(edge, edge)
        along = np.clip(_dot(edge, to) / np.where(square > 0, square, 1), 0, 1)
        distance = np.square(to - along[:, None] * edge).sum(axis=1)
        nearer = distance < best
        best = np.where(nearer, distance, best)
        edge_bary[nearer] = 0
        edge_bary[nearer, i] = 1 - along[nearer]
        edge_bary[nearer, j] = along[nearer]
    inside[outside] = edge_bary
    return inside


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ij,ij->i", a, b)


def _sentence(label: str) -> str:
    return label[:1].upper() + label[1:]
