# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights given to splats outright, and their number held down."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.lbs import top_influences
from .body_graph import BodyGraph, along_body

Array = NDArray[Any]


def to_bone(weights: Array, bone: int, selected: Array, *, rim: float = 0.0, graph: BodyGraph | None = None) -> Array:
    """(N, B) float32: the selected splats follow one bone alone; around them its share fades out along the body.

    weights (N, B), rows sum to 1; selected (N,) bool; rim: metres over which it fades, 0 for a hard border, else
    with the graph of the body. Splats further off keep theirs to the bit.
    """
    out = np.array(weights, np.float32)
    if rim > 0 and graph is not None:
        distance = along_body(graph, selected, rim)
        way = np.clip(1 - distance / rim, 0, 1)
        share = (way * way * (3 - 2 * way)).astype(np.float32)
    else:
        share = np.asarray(selected, bool).astype(np.float32)
    rows = np.flatnonzero(share > 0)
    part = share[rows, None]
    mixed = out[rows] * (1 - part)
    mixed[:, bone] += part[:, 0]
    out[rows] = mixed
    return out


def flood(weights: Array, bone: int, value: float, selected: Array) -> Array:
    """(N, B) float32: the bone has the weight `value`, 0..1, on the selected splats (N,) bool; the others share the
    rest as they did, or keep it with the bone where no other has any.

    weights (N, B), rows sum to 1.
    """
    out = np.array(weights, np.float32)
    rows = np.flatnonzero(selected)
    part = out[rows]
    part[:, bone] = 0
    rest = part.sum(axis=1, keepdims=True)
    alone = rest[:, 0] <= 0
    part *= (1 - value) / np.where(rest > 0, rest, 1)
    part[:, bone] = np.where(alone, 1, value)
    out[rows] = part
    return out


def limit(weights: Array, count: int) -> Array:
    """(N, B) float32: only the `count` >= 1 strongest bones of each splat, rows sum to 1.

    weights (N, B), rows with a positive sum.
    """
    weights = np.asarray(weights, np.float32)
    if count >= weights.shape[1]:
        return normalise(weights)
    index, value = top_influences(weights, count)
    out = np.zeros_like(weights)
    np.put_along_axis(out, index, value, axis=1)
    return normalise(out)


def normalise(weights: Array) -> Array:
    """(N, B) float32: rows sum to 1; rows of zeros stay."""
    weights = np.maximum(np.asarray(weights, np.float32), 0)
    total = weights.sum(axis=1, keepdims=True, dtype=np.float64)
    return np.asarray(weights / np.where(total > 0, total, 1), np.float32)
