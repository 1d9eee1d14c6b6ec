# SPDX-License-Identifier: GPL-3.0-or-later
"""Closed triangle meshes of simple shapes, (verts (V, 3), faces (F, 3)), wound outwards, in metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mesh = tuple[Array, NDArray[np.int64]]


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of all, in the given order."""
    starts = np.cumsum([0, *(len(verts) for verts, _ in meshes)])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
    return np.concatenate([verts for verts, _ in meshes]), np.concatenate(faces)


def mirrored(mesh: Mesh) -> Mesh:
    """The mesh on the other side of the plane x = 0."""
    verts, faces = mesh
    return verts * (-1.0, 1.0, 1.0), faces[:, ::-1].copy()


def ellipsoid(center: ArrayLike, radii: ArrayLike, rings: int = 24, segments: int = 40) -> Mesh:
    """An axis-aligned ellipsoid."""
    polar = np.linspace(0, np.pi, rings + 1)
    profile = np.stack([np.sin(polar), np.cos(polar)], axis=1)
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(segments)], axis=1)
    grid = ring[None] * profile[:, 0, None, None] + np.array([0, 0, 1.0]) * profile[:, 1, None, None]
    return grid.reshape(-1, 3) * np.asarray(radii, float) + np.asarray(center, float), _tube_faces(rings + 1, segments)


def smooth_line(points: ArrayLike, steps: int) -> Array:
    """A Catmull-Rom curve through the rows of `points` (n, k), `steps` rows per stretch, ends included."""
    p = np.asarray(points, float)
    padded = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    rows = []
    for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        rows.append(0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3))
    return np.concatenate([*rows, p[-1:]])


def tube(
    points: ArrayLike, radii: ArrayLike, *, steps: int = 8, segments: int = 24, flat: ArrayLike | None = None
) -> Mesh:
    """A round tube with spherical ends along a smooth curve.

    points (n, 3); radii (n,). `flat` = (axis x, y, z, factor) squeezes the cross section along that axis.
    """
    line = smooth_line(np.column_stack([np.asarray(points, float), np.asarray(radii, float)]), steps)
    center, radius = line[:, :3], np.maximum(line[:, 3], 1e-4)
    tangent = np.gradient(center, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    cap = np.linspace(0, np.pi / 2, 7)[:-1]
    head = [(center[0] - tangent[0] * radius[0] * np.cos(a), tangent[0], radius[0] * np.sin(a)) for a in cap]
    tail = [(center[-1] + tangent[-1] * radius[-1] * np.cos(a), tangent[-1], radius[-1] * np.sin(a)) for a in cap[::-1]]
    stations = [*head, *zip(center, tangent, radius, strict=True), *tail]
    side = np.cross(tangent[0], [0.0, 0.0, 1.0] if abs(tangent[0][2]) < 0.9 else [0.0, 1.0, 0.0])
    rings = []
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    for middle, axis, r in stations:
        side = side - axis * (side @ axis)
        side = side / np.linalg.norm(side)
        up = np.cross(axis, side)
        offset = r * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * up)
        if flat is not None:
            direction = np.asarray(flat, float)[:3]
            direction = direction / np.linalg.norm(direction)
            offset -= (1 - float(np.asarray(flat, float)[3])) * np.outer(offset @ direction, direction)
        rings.append(middle + offset)
    # The rings run along the axis, so the faces turn the other way than on the ellipsoid (top to bottom).
    return np.concatenate(rings), _tube_faces(len(rings), segments)[:, ::-1].copy()


def torus(center: ArrayLike, radii: ArrayLike, thickness: ArrayLike, segments: int = 64, sides: int = 16) -> Mesh:
    """A level ring: `radii` (x, y) of its middle line, `thickness` (across, up) of its half section."""
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    around = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    direction = np.stack([np.cos(turn), np.sin(turn), np.zeros(segments)], axis=1)
    middle = direction * np.append(np.asarray(radii, float), 0.0)
    across, up = (float(x) for x in np.asarray(thickness, float))
    grid = (
        middle[:, None]
        + direction[:, None] * (across * np.cos(around))[None, :, None]
        + np.array([0, 0, up]) * np.sin(around)[None, :, None]
    )
    i, j = np.meshgrid(np.arange(segments), np.arange(sides), indexing="ij")
    a, b = i * sides + j, ((i + 1) % segments) * sides + j
    c, d = ((i + 1) % segments) * sides + (j + 1) % sides, i * sides + (j + 1) % sides
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return grid.reshape(-1, 3) + np.asarray(center, float), faces


def cloth(outer: Array, thickness: float) -> Mesh:
    """A closed sheet from a grid (rows, columns, 3) of its outer side; the inner one lies `thickness` in."""
    rows, columns, _ = outer.shape
    along, across = np.gradient(outer, axis=0), np.gradient(outer, axis=1)
    normal = np.cross(across, along)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-9)
    inner = outer - thickness * normal
    verts = np.concatenate([outer.reshape(-1, 3), inner.reshape(-1, 3)])
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a, b = (i * columns + j).ravel(), (i * columns + j + 1).ravel()
    c, d = b + columns, a + columns
    front = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    back = front[:, ::-1] + rows * columns
    edge = np.concatenate(
        [
            np.arange(columns),
            np.arange(1, rows) * columns + columns - 1,
            (rows - 1) * columns + np.arange(columns - 1)[::-1],
            np.arange(1, rows - 1)[::-1] * columns,
        ]
    )
    nxt = np.roll(edge, -1)
    far = rows * columns
    rim = np.concatenate([np.stack([nxt, edge, edge + far], 1), np.stack([nxt, edge + far, nxt + far], 1)])
    return verts, np.concatenate([front, back, rim])


def _tube_faces(rings: int, segments: int) -> NDArray[np.int64]:
    """Triangles between consecutive rings of points."""
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(segments), indexing="ij")
    a, b = i * segments + j, i * segments + (j + 1) % segments
    c, d = b + segments, a + segments
    return np.stack([np.stack([a, d, c], -1), np.stack([a, c, b], -1)]).reshape(-1, 3)
