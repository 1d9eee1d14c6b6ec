# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights made softer, harder, or as their neighbours have them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...splats.components import connected_components, unique_edges
from ...ticks import Tick, silent
from ..laplacian import GraphLaplacian
from .body_graph import BodyGraph

Array = NDArray[Any]


def smooth(
    weights: Array,
    graph: BodyGraph,
    *,
    selected: Array | None = None,
    factor: float = 0.5,
    repeat: int = 1,
    tick: Tick = silent,
) -> Array:
    """(N, B) float32: every selected splat a step towards the mean of its neighbours, `repeat` times.

    weights (N, B); selected (N,) bool, all where left out: splats that are not selected stay and are counted as
    neighbours; factor 0..1: the length of the step. A splat without neighbours stays.
    """
    out = np.array(weights, np.float32)
    count = graph.linked.sum(axis=1)
    rows = np.flatnonzero((count > 0) if selected is None else (np.asarray(selected, bool) & (count > 0)))
    if not len(rows):
        return out
    neighbour, linked = graph.neighbour[rows], graph.linked[rows].astype(np.float32)
    for turn in range(repeat):
        tick(turn / repeat)
        mean = np.zeros((len(rows), out.shape[1]), np.float32)
        for k in range(neighbour.shape[1]):
            mean += out[neighbour[:, k]] * linked[:, k, None]
        mean /= count[rows, None]
        out[rows] += np.float32(factor) * (mean - out[rows])
    return out


def sharpen(weights: Array, amount: float = 0.5) -> Array:
    """(N, B) float32: the strongest bones of each splat made stronger, rows sum to 1.

    weights (N, B), rows with a positive sum; amount 0 changes nothing, 1 leaves the strongest bone alone (bones that
    are equally strong share). In between, weights are raised to the power 1 / (1 - amount).
    """
    weights = np.asarray(weights, np.float64)
    top = weights.max(axis=1, keepdims=True)
    relative = weights / np.where(top > 0, top, 1)
    hard = (relative == 1).astype(np.float64) if amount >= 1 else relative ** (1 / (1 - amount))
    return _normalised(hard)


def follow_neighbours(weights: Array, graph: BodyGraph, selected: Array, tick: Tick = silent) -> tuple[Array, Array]:
    """The selected splats take the weights that pass most smoothly between the splats around them.

    weights (N, B); selected (N,) bool. Returns (N, B) float32, rows of the changed splats sum to 1, and (N,) bool: the
    selected splats that nothing around them holds, which stay. The harmonic weights: each is the mean of its
    neighbours' (Laplace's equation on the graph).
    """
    out = np.array(weights, np.float32)
    selected = np.asarray(selected, bool)
    count, k = graph.neighbour.shape
    source = np.repeat(np.arange(count), k)[graph.linked.ravel()]
    edges = np.stack([source, graph.neighbour[graph.linked]], axis=1)
    edges = unique_edges(edges[selected[edges].any(axis=1)])
    piece = connected_components(count, *edges[selected[edges].all(axis=1)].T)
    beside = edges[selected[edges].sum(axis=1) == 1]
    held = np.zeros(count, bool)
    held[piece[np.where(selected[beside[:, 0]], beside[:, 0], beside[:, 1])]] = True
    free = selected & held[piece]
    place = np.full(count, -1)
    place[free] = np.arange(int(free.sum()))
    inner = edges[free[edges].all(axis=1)]
    rim = np.where(selected[beside[:, :1]], beside, beside[:, ::-1])  # the selected splat first
    mass = np.bincount(place[rim[:, 0]], minlength=int(free.sum())).astype(np.float64)
    pull = np.zeros((len(mass), out.shape[1]))
    np.add.at(pull, place[rim[:, 0]], out[rim[:, 1]].astype(np.float64))
    if len(mass):
        found = GraphLaplacian(len(mass), place[inner]).solve(mass, pull, tick=tick)
        out[free] = _normalised(np.maximum(found, 0))
    return out, selected & ~free


def _normalised(weights: Array) -> Array:
    total = weights.sum(axis=1, keepdims=True)
    return np.asarray(weights / np.where(total > 0, total, 1), np.float32)
