# SPDX-License-Identifier: GPL-3.0-or-later
"""Which splats are neighbours on the body, and how far it is from one to another along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.nearest_points import nearest_points
from ..walls import blocked

Array = NDArray[Any]

NEIGHBOURS = 12
REACH = 3.0
"""A neighbour further than this times the usual way to the one farthest of `NEIGHBOURS` is none: there is a gap."""


@dataclass(frozen=True, eq=False)
class BodyGraph:
    """neighbour (N, K) int64: the splats beside each splat, itself where there are fewer; length (N, K) float32, the
    way to them in metres, infinite where there are fewer."""

    neighbour: Array
    length: Array

    @property
    def linked(self) -> Array:
        """(N, K) whether there is such a neighbour."""
        return np.isfinite(self.length)


def body_graph(means: Array, *, neighbours: int = NEIGHBOURS, walls: Array | None = None) -> BodyGraph:
    """The `neighbours` nearest splats of each of means (N, 3), metres, but for those across a gap or a wall.

    walls (N,): labels, see `walls`. N >= 1.
    """
    means = np.asarray(means, np.float64)
    k = min(neighbours + 1, len(means))
    length, neighbour = nearest_points(means, means, k)
    own = np.arange(len(means))[:, None]
    # Of splats that lie on one another another one may come first.
    itself = neighbour == own
    itself[~itself.any(axis=1), -1] = True
    neighbour, length = neighbour[~itself].reshape(len(means), k - 1), length[~itself].reshape(len(means), k - 1)
    far = REACH * float(np.median(length[:, -1])) if k > 1 else 0.0
    apart = length > far
    if walls is not None:
        apart |= blocked(np.asarray(walls)[:, None], np.asarray(walls)[neighbour])
    neighbour = np.where(apart, own, neighbour)
    return BodyGraph(neighbour, np.where(apart, np.inf, length).astype(np.float32))


def along_body(graph: BodyGraph, seeds: Array, limit: float) -> Array:
    """(N,) float32 metres from each splat to the nearest of the seeds (N,) bool along the body; infinite beyond
    `limit`, metres.

    Shortest ways over the edges of the graph in both directions (Bellman-Ford).
    """
    count, k = graph.neighbour.shape
    source = np.repeat(np.arange(count), k)[graph.linked.ravel()]
    target, length = graph.neighbour[graph.linked], graph.length[graph.linked]
    source, target = np.concatenate([source, target]), np.concatenate([target, source])
    length = np.concatenate([length, length])
    order = np.argsort(source, kind="stable")
    target, length = target[order], length[order]
    starts = np.searchsorted(source[order], np.arange(count + 1))
    distance = np.where(seeds, np.float32(0), np.float32(np.inf))
    open_ = np.flatnonzero(seeds)
    while len(open_):
        sizes = starts[open_ + 1] - starts[open_]
        flat = np.repeat(starts[open_] - np.cumsum(sizes) + sizes, sizes) + np.arange(int(sizes.sum()))
        reached = np.repeat(distance[open_], sizes) + length[flat]
        near = reached <= limit
        before = distance.copy()
        np.minimum.at(distance, target[flat[near]], reached[near])
        open_ = np.flatnonzero(distance < before)
    return distance


def grow(graph: BodyGraph, selected: Array, steps: int = 1) -> Array:
    """(N,) bool: the selected splats (N,) and those up to `steps` neighbours further; fewer for negative steps."""
    selected = np.asarray(selected, bool).copy()
    if steps < 0:
        return np.asarray(~grow(graph, ~selected, -steps))
    for _ in range(steps):
        around = graph.neighbour[selected][graph.linked[selected]]
        beside = (selected[graph.neighbour] & graph.linked).any(axis=1)
        selected |= beside
        selected[around] = True
    return selected
