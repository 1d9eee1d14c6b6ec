# SPDX-License-Identifier: GPL-3.0-or-later
"""Walls between parts of a body that touch but do not belong together, such as a forearm fused to a hip.

Splats have labels, 0 for none; a wall lies between two labels that are not 0 and differ.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.nearest_points import nearest_points

Array = NDArray[Any]


def blocked(first: Any, second: Any) -> Array:
    """Whether a wall lies between splats with the labels `first` and `second`, arrays or numbers."""
    return np.asarray((first != second) & (first != 0) & (second != 0))


def nearest_open(
    points: Array, queries: Array, labels: Array | None = None, own: Array | None = None
) -> tuple[Array, Array]:
    """Distance and index (Q,) of the nearest of points (N, 3) that no wall separates from each query (Q, 3).

    labels (N,) of the points and own (Q,) of the queries, None without walls. If there is none, the nearest of all
    points.
    """
    if labels is None or own is None:
        way, index = nearest_points(points, queries, 1)
        return way[:, 0], index[:, 0]
    distance, nearest = np.empty(len(queries)), np.empty(len(queries), np.int64)
    for label in np.unique(own):
        rows = np.flatnonzero(own == label)
        among = np.flatnonzero(~blocked(labels, label))
        if not len(among):
            among = np.arange(len(points))
        way, index = nearest_points(points[among], queries[rows], 1)
        distance[rows], nearest[rows] = way[:, 0], among[index[:, 0]]
    return distance, nearest
