# SPDX-License-Identifier: GPL-3.0-or-later
"""Edges across the shortest gaps between the pieces of a body, which make it connected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.nearest_points import nearest_points
from ..splats.components import connected_components, unique_edges

Array = NDArray[Any]


def bridge_pieces(points: Array, piece: Array, walls: Array | None = None, *, beside: float = 0.0) -> Array:
    """Edges (E, 2) across the gaps between pieces, so that all are connected: each is joined to the nearest other,
    repeatedly (Boruvka 1926).

    points (N, 3); piece (N,): labels; walls (N,): labels, see `walls`. A gap across a wall is used only if a piece has
    no other. Each gap gets one edge, the shortest; or, with `beside` > 0 and no wall, all edges from points of the
    smaller piece to the nearest point of the others that are at most 1.5 times as long plus `beside`.
    """
    piece = np.unique(piece, return_inverse=True)[1].reshape(-1)
    edges = [np.zeros((0, 2), np.int64)]
    while (count := int(piece.max(initial=0)) + 1) > 1:
        source = np.flatnonzero(piece != np.bincount(piece).argmax())
        way, other = _nearest_elsewhere(points, piece, source, walls)
        shortest = np.full(count, np.inf)
        np.minimum.at(shortest, piece[source], way)
        lost = np.isinf(shortest)[piece[source]]
        if lost.any():
            way[lost], other[lost] = _nearest_elsewhere(points, piece, source[lost], None)
        order = np.lexsort((way, piece[source]))
        chosen = np.zeros(len(source), bool)
        chosen[order[np.append(True, np.diff(piece[source][order]) > 0)]] = True
        if beside > 0:
            chosen |= ~lost & np.isfinite(way) & (way <= 1.5 * shortest[piece[source]] + beside)
        added = np.stack([source[chosen], other[chosen]], axis=1)
        edges.append(added)
        joined = connected_components(count, piece[added[:, 0]], piece[added[:, 1]])
        piece = np.unique(joined, return_inverse=True)[1].reshape(-1)[piece]
    return unique_edges(np.concatenate(edges))


def _nearest_elsewhere(points: Array, piece: Array, rows: Array, walls: Array | None) -> tuple[Array, Array]:
    """Distance and index of the nearest point of another piece for the points `rows`, infinite if walls block all.

    Pieces differ in some bit of their numbers, so two searches for every bit find them all.
    """
    way, other = np.full(len(rows), np.inf), np.zeros(len(rows), np.int64)
    for bit in range(int(piece.max()).bit_length()):
        side = (piece >> bit) & 1
        for value in (0, 1):
            mine = np.flatnonzero(side[rows] == value)
            for among, target in _open_ways(rows[mine], np.flatnonzero(side != value), walls):
                found, at = nearest_points(points[target], points[rows[mine[among]]], 1)
                asked = mine[among]
                better = found[:, 0] < way[asked]
                way[asked[better]], other[asked[better]] = found[better, 0], target[at[better, 0]]
    return way, other


def _open_ways(rows: Array, targets: Array, walls: Array | None) -> Iterator[tuple[Array, Array]]:
    """Parts of `rows`, as indices into it, and for each the targets that no wall separates from them."""
    labels = np.zeros(1, np.int64) if walls is None else np.unique(walls[rows])
    for label in labels:
        among = np.arange(len(rows)) if walls is None else np.flatnonzero(walls[rows] == label)
        target = targets
        if walls is not None and label != 0:
            target = targets[(walls[targets] == 0) | (walls[targets] == label)]
        if len(among) and len(target):
            yield among, target
