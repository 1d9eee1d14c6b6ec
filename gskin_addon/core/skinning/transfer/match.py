# SPDX-License-Identifier: GPL-3.0-or-later
"""What lies where on another shape, and whether it can be meant: near enough, and facing the same way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.nearest import nearest_triangles
from ...rig.nearest_points import nearest_points
from ...ticks import Tick, silent

Array = NDArray[Any]

REACH = 0.05
"""A match further than this share of the source's diagonal is none, as in the paper."""
ANGLE = 45.0
"""Degrees that the facing of a match may differ. The paper's 30 are for meshes; normals of splats are rougher."""
_CLOSE, _WIDE = 0.01, 120.0
"""Towards a distance of 0 the angle widens to `_WIDE` degrees, from this share of the diagonal on: what lies on the
source is meant, whatever its rough normal says."""
NEAREST = 8
"""Splats around a point that give it weights."""


@dataclass(frozen=True, eq=False)
class Match:
    """weights (N, B) float32, rows sum to 1 or are 0 where the source has none; sure (N,) bool."""

    weights: Array
    sure: Array


def on_surface(
    points: Array,
    facing: Array | None,
    verts: Array,
    faces: Array,
    vertex_facing: Array,
    weights: Array,
    *,
    reach: float = REACH,
    angle: float = ANGLE,
    piece: Array | None = None,
) -> Match:
    """Weights of the closest point on a mesh for each of points (N, 3).

    facing (N, 3) of the points, see `facing`, None for any; verts (V, 3), faces (F, 3), F >= 1, vertex_facing (V, 3),
    weights (V, B) of the mesh; reach: share of the mesh's diagonal; angle in degrees; piece (F,): numbers from 0 on of
    the pieces that hang together, each of which is turned where most of what lies on it faces the other way: it was
    wound inside out. ValueError for no triangles.
    """
    points, verts = np.asarray(points, np.float64), np.asarray(verts, np.float64)
    face, bary = nearest_triangles(points, verts[faces])
    corner = np.asarray(faces)[face]
    away = np.linalg.norm(np.einsum("nk,nkd->nd", bary, verts[corner]) - points, axis=1)
    found = _blend(weights, corner, bary)
    near = away <= reach * _diagonal(verts)
    sure = near & _given(found)
    if facing is not None:
        normal = np.einsum("nk,nkd->nd", bary, vertex_facing[corner])
        if piece is not None:
            same = np.einsum("nk,nk->n", facing, normal) * near
            normal *= np.where(np.bincount(piece[face], same) < 0, -1.0, 1.0)[piece[face], None]
        sure &= agree(facing, normal, _allowed(angle, away / _diagonal(verts)))
    return Match(found, sure)


def among_points(
    points: Array,
    facing: Array | None,
    others: Array,
    other_facing: Array | None,
    weights: Array,
    *,
    reach: float = REACH,
    angle: float = ANGLE,
    nearest: int = NEAREST,
    tick: Tick = silent,
) -> Match:
    """Weights of the `nearest` of the others (M, 3), M >= 1, for each of points (N, 3), the nearer the more.

    Only others count that face as the point does, facing (N, 3) and other_facing (M, 3), and that have weights (M, B);
    a point with none of them within reach, a share of the others' diagonal, is unsure and gets the mean of all nearest.
    """
    points, others = np.asarray(points, np.float64), np.asarray(others, np.float64)
    away, index = nearest_points(others, points, min(nearest, len(others)))
    tick(0.5)
    good = (away <= reach * _diagonal(others)) & _given(weights)[index]
    if facing is not None and other_facing is not None:
        for k in range(index.shape[1]):
            allowed = _allowed(angle, away[:, k] / _diagonal(others))
            good[:, k] &= agree(facing, other_facing[index[:, k]], allowed)
    sure = good.any(axis=1)
    share = np.where(sure[:, None], good, True) * _falloff(away)
    return Match(_blend(weights, index, share), sure)


def agree(one: Array, other: Array, angle: Any) -> Array:
    """(N,) whether directions (N, 3) and (N, 3) are within `angle` degrees, a number or (N,).

    Their lengths, up to 1, are how sure the sign of each is: unsure ones agree with their opposites, too.
    """
    lengths = np.linalg.norm(one, axis=1), np.linalg.norm(other, axis=1)
    product = np.maximum(lengths[0] * lengths[1], 1e-12)
    cosine = np.einsum("nk,nk->n", one, other) / product
    certain = np.clip(np.minimum(*lengths), 0, 1)
    lowest = np.cos(np.radians(angle))
    known = np.minimum(*lengths) > 1e-6
    return np.asarray(~known | (cosine >= lowest) | ((cosine <= -lowest) & (certain < 0.3)))


def _allowed(angle: float, away: Array) -> Array:
    """(N,) degrees that facing may differ at distances (N,), shares of the diagonal."""
    return np.asarray(angle + max(_WIDE - angle, 0.0) * np.clip(1 - away / _CLOSE, 0, 1))


def _falloff(away: Array) -> Array:
    """(N, K) shares of neighbours at ascending distances (N, K): 1 / d^2, but for a soft core."""
    core = 0.1 * away[:, -1:] + 1e-12
    return np.asarray(1 / (np.square(away) + np.square(core)))


def _blend(weights: Array, index: Array, share: Array) -> Array:
    """(N, B) float32: rows index (N, K) of weights (V, B) by their shares (N, K); rows sum to 1, or are 0."""
    out = np.zeros((len(index), np.shape(weights)[1]), np.float32)
    share = np.asarray(share / np.maximum(share.sum(axis=1, keepdims=True), 1e-30), np.float32)
    for k in range(index.shape[1]):
        out += share[:, k, None] * weights[index[:, k]]
    total = out.sum(axis=1, keepdims=True)
    return np.asarray(out / np.where(total > 1e-6, total, np.inf), np.float32)


def _given(weights: Array) -> Array:
    """(N,) which rows have any weight."""
    return np.asarray(np.asarray(weights).sum(axis=1) > 1e-6)


def _diagonal(points: Array) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))
