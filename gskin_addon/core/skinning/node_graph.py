# SPDX-License-Identifier: GPL-3.0-or-later
"""A sparse graph of nodes on the splats, for deformations that do not need every splat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.nearest_points import nearest_points
from ..splats.components import connected_components, unique_edges
from .gaps import bridge_pieces
from .walls import blocked, nearest_open


@dataclass(frozen=True)
class NodeGraph:
    """Nodes that stand for the splats around them.

    nodes (M,): indices of the splats that serve as nodes; edges (E, 2): pairs of nodes;
    anchor (N, K) and anchor_weight (N, K): the nodes that carry each splat, rows sum to 1.
    """

    nodes: NDArray[np.int64]
    edges: NDArray[np.int64]
    anchor: NDArray[np.int64]
    anchor_weight: NDArray[np.float64]


# Two splats whose distances to some bone differ by more than this times the way between them do not touch.
GAP_RATIO = 2.0


def build_graph(
    means: NDArray[Any],
    distances: NDArray[Any],
    count: int = 4000,
    *,
    neighbours: int = 10,
    anchors: int = 4,
    walls: NDArray[Any] | None = None,
) -> NodeGraph:
    """Choose about `count` evenly spread nodes and connect each to its `neighbours` nearest.

    means (N, 3); distances (N, B) to the bones through the body. Along the body such a distance changes by
    no more than the way gone, so a larger change between neighbours betrays a gap (two legs side by side):
    neither edges nor anchors lead across it. Separate pieces are joined by their shortest gaps, so that the
    graph is connected. walls (N,): labels, see `walls`; neither edges nor anchors lead across one, but for a bridge
    to a piece that has no other.
    """
    nodes = _even_subset(means, count)
    points = np.asarray(means[nodes], np.float64)
    k = min(neighbours + 1, len(nodes))
    length, index = nearest_points(points, points, k)
    pitch = float(np.median(length[:, 1:]))
    edges = np.stack([np.repeat(np.arange(len(nodes)), k - 1), index[:, 1:].ravel()], axis=1)
    edges = unique_edges(edges)
    profile = np.asarray(distances, np.float32)
    a, b = edges.T
    edges = edges[~_gap(points[a], points[b], profile[nodes[a]], profile[nodes[b]], pitch)]
    label = None if walls is None else np.asarray(walls)[nodes]
    if label is not None:
        edges = edges[~blocked(label[edges[:, 0]], label[edges[:, 1]])]
    edges = np.concatenate([edges, bridge_pieces(points, connected_components(len(nodes), *edges.T), label)])

    distance, anchor = nearest_points(points, means, min(2 * anchors, len(nodes)))
    apart = np.stack([_gap(means, points[i], profile, profile[nodes[i]], pitch) for i in anchor.T], axis=1)
    if label is None or walls is None:
        apart[apart.all(axis=1), 0] = False
    else:
        own = np.asarray(walls)
        apart |= blocked(own[:, None], label[anchor])
        alone = np.flatnonzero(apart.all(axis=1))
        distance[alone, 0], anchor[alone, 0] = nearest_open(points, means[alone], label, own[alone])
        apart[alone, 0] = False
    ranked = np.argsort(np.where(apart, np.inf, distance), axis=1, kind="stable")[:, : anchors + 1]
    anchor, distance, apart = (np.take_along_axis(a, ranked, 1) for a in (anchor, distance, apart))
    # The first node left out sets the reach, so that anchors fade out before they are exchanged.
    reach = np.where(apart, 0.0, distance).max(axis=1, keepdims=True) * 1.001 + 1e-12
    weight = np.where(apart, 0.0, (1 - distance / reach) ** 2 + 1e-9)[:, :anchors]
    anchor = anchor[:, :anchors]
    return NodeGraph(nodes, edges, anchor, weight / weight.sum(1, keepdims=True))


def _gap(
    a: NDArray[Any],
    b: NDArray[Any],
    profile_a: NDArray[Any],
    profile_b: NDArray[Any],
    pitch: float,
) -> NDArray[np.bool_]:
    """Whether the bodies of points a and b (K, 3) are apart, from their distances to all bones (K, B)."""
    way = np.linalg.norm(np.asarray(a) - b, axis=1)
    return np.abs(profile_a - profile_b).max(axis=1) > GAP_RATIO * np.maximum(way, pitch)


def _even_subset(means: NDArray[Any], count: int) -> NDArray[np.int64]:
    """About `count` splats, one per voxel of a grid whose pitch is searched for by halving."""
    if len(means) <= count:
        return np.arange(len(means))
    lower = np.percentile(means, 0.1, axis=0)
    side = float(np.ptp(np.percentile(means, [0.1, 99.9], axis=0), axis=0).max())
    low, high = 1.0, 2048.0
    for _ in range(14):
        middle = float(np.sqrt(low * high))
        cells = np.floor((means - lower) / side * middle).astype(np.int64)
        taken = np.unique(_key(cells), return_index=True)[1]
        low, high = (middle, high) if len(taken) < count else (low, middle)
    # The most central splat of each voxel keeps the nodes evenly spaced.
    offset = np.square((means - lower) / side * middle - cells - 0.5).sum(1)
    order = np.argsort(offset, kind="stable")
    return np.sort(order[np.unique(_key(cells[order]), return_index=True)[1]])


def _key(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) one number for each cell (N, 3), in the order of x, then y, then z."""
    cells = cells - cells.min(axis=0)
    size = cells.max(axis=0) + 1
    return np.asarray((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2])
