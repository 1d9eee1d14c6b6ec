# SPDX-License-Identifier: GPL-3.0-or-later
"""The nearest points of a set to other points, exactly, in numpy alone (Blender's Python has no scipy).

Both are sorted along one Morton curve. Queries that lie together form a group; a hierarchy of boxes over the points is
descended by all groups side by side, which leaves each group a short list of points that may be among the nearest.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..splats.morton import BITS, morton_keys

Array = NDArray[Any]

_WIDTH = 8  # points in a box, and boxes in a box
_GROUP = 12  # most queries in a group; few, so that for a dozen neighbours fewer points have to be looked at
_BATCH = 1 << 18  # pairs whose distances are found at once


def nearest_points(points: Array, queries: Array, k: int) -> tuple[Array, Array]:
    """Distances (Q, k) float64, ascending, and indices (Q, k) int64 of the k points nearest to every query.

    points (N, 3), N >= k >= 1; queries (Q, 3). Equally near points come in no particular order.
    """
    points, queries = np.asarray(points, np.float64), np.asarray(queries, np.float64)
    if not 1 <= k <= len(points):
        raise ValueError(f"{k} nearest of {len(points)} points")
    if len(queries) == 0:
        return np.zeros((0, k)), np.zeros((0, k), np.int64)
    low = np.minimum(points.min(axis=0), queries.min(axis=0))
    side = float((np.maximum(points.max(axis=0), queries.max(axis=0)) - low).max()) or 1.0
    scale = (2**BITS - 1) / side
    key = morton_keys((points - low) * scale)
    order = np.argsort(key, kind="stable")
    key, points = key[order], points[order]
    asked = morton_keys((queries - low) * scale)
    row = np.argsort(asked, kind="stable")
    asked, queries = asked[row], queries[row]

    starts = _groups(key, asked, k)
    sizes = np.diff(np.append(starts, len(queries)))
    lower, upper = np.minimum.reduceat(queries, starts), np.maximum.reduceat(queries, starts)
    centre, radius = (lower + upper) / 2, np.linalg.norm(upper - lower, axis=1) / 2
    boxes = _boxes(points)
    # Points close by on the curve give a first bound on the distance of the k-th one; far outside, where the curve
    # says little, those in the box that looks nearest give a better one.
    bound = _bound(points, centre, np.searchsorted(key, asked[starts + sizes // 2]), k)
    bound = np.minimum(bound, _bound(points, centre, _greedy(boxes, centre), k))
    # Within a group the k-th distance differs from that of its centre by at most the radius.
    begin, count, flat = _candidates(boxes, centre, bound * (1 + 1e-12) + 2 * radius)
    several = sizes > 1
    if several.any():
        way = np.empty(len(starts))
        way[several] = _smallest(points, centre[several], begin[several], count[several], flat, k)[0][:, -1]
        owner = np.repeat(np.arange(len(starts)), count)
        keep = ~several[owner]
        reach = way * (1 + 1e-12) + 2 * radius
        for first in range(0, len(flat), _BATCH):
            part = slice(first, first + _BATCH)
            off = points[flat[part]] - centre[owner[part]]
            with np.errstate(invalid="ignore"):
                keep[part] |= np.einsum("nk,nk->n", off, off) <= np.square(reach[owner[part]] * (1 + 1e-12))
        flat = flat[keep]
        count = np.bincount(owner[keep], minlength=len(starts))
        begin = np.cumsum(count) - count
    group = np.repeat(np.arange(len(starts)), sizes)
    way, index = _smallest(points, queries, begin[group], count[group], flat, k)
    distance, nearest = np.empty_like(way), np.empty((len(queries), k), np.int64)
    distance[row], nearest[row] = way, order[index]
    return distance, nearest


def _groups(key: Array, asked: Array, k: int) -> Array:
    """Where groups of queries start: those in one cell of the curve, at most `_GROUP`; a cell holds about k points."""
    for level in range(0, 3 * BITS + 1, 3):  # of 3 bits: from all in one cell to the finest cells
        shift = np.uint64(3 * BITS - level)
        cells = key >> shift
        if level == 3 * BITS or 1 + np.count_nonzero(cells[1:] != cells[:-1]) >= len(key) / k:
            break
    cell = asked >> shift
    new = np.flatnonzero(np.concatenate([[True], cell[1:] != cell[:-1]]))
    sizes = np.diff(np.append(new, len(asked)))
    parts = -(-sizes // _GROUP)
    first = np.cumsum(parts) - parts
    number = np.arange(int(parts.sum())) - np.repeat(first, parts)
    return np.repeat(new, parts) + number * _GROUP


def _bound(points: Array, centre: Array, near: Array, k: int) -> Array:
    """(G,) the k-th smallest distance from each centre (G, 3) to the points around point near (G,)."""
    window = min(2 * k + _WIDTH, len(points))
    begin = np.clip(near - window // 2, 0, len(points) - window)
    bound = np.empty(len(centre))
    step = max(1, _BATCH // window)
    for first in range(0, len(centre), step):
        block = slice(first, first + step)
        beside = points[begin[block, None] + np.arange(window)] - centre[block, None]
        bound[block] = np.partition(np.einsum("gwk,gwk->gw", beside, beside), k - 1, axis=1)[:, k - 1]
    return np.sqrt(bound)


def _boxes(points: Array) -> list[tuple[Array, Array]]:
    """Lower and upper corners of runs of `_WIDTH` points, of runs of those, and so on; the points come first."""
    boxes = [(points, points)]
    while len(boxes[-1][0]) > _WIDTH or len(boxes) == 1:
        starts = np.arange(0, len(boxes[-1][0]), _WIDTH)
        boxes.append((np.minimum.reduceat(boxes[-1][0], starts), np.maximum.reduceat(boxes[-1][1], starts)))
    return boxes


def _greedy(boxes: list[tuple[Array, Array]], centre: Array) -> Array:
    """(G,) a point that is nearly the nearest to each centre (G, 3)."""
    at = np.zeros(len(centre), np.int64)
    for lower, upper in boxes[::-1]:
        child = np.minimum(at[:, None] * _WIDTH + np.arange(_WIDTH), len(lower) - 1)
        gap = np.maximum(np.maximum(lower[child] - centre[:, None], centre[:, None] - upper[child]), 0)
        # Inside several boxes at once, the one with the nearer middle.
        off = (lower[child] + upper[child]) / 2 - centre[:, None]
        far = np.einsum("gck,gck->gc", gap, gap) + 1e-3 * np.einsum("gck,gck->gc", off, off)
        at = np.take_along_axis(child, far.argmin(axis=1)[:, None], 1)[:, 0]
    return at


def _candidates(boxes: list[tuple[Array, Array]], centre: Array, reach: Array) -> tuple[Array, Array, Array]:
    """For every group the points in boxes that come closer to its centre than its reach.

    Returns begin (G,), count (G,) and the indices of points, group by group.
    """
    lists, counts = [], []
    step = 4096  # groups at a time: bounds the number of pairs
    for first in range(0, len(centre), step):
        at, far = centre[first : first + step], np.square(reach[first : first + step])
        top = len(boxes[-1][0])
        who, box = np.repeat(np.arange(len(at)), top), np.tile(np.arange(top), len(at))
        for level in range(len(boxes) - 1, 0, -1):
            lower, upper = boxes[level]
            gap = at[who]
            gap = np.maximum(np.maximum(lower[box] - gap, gap - upper[box]), 0)
            keep = np.einsum("nk,nk->n", gap, gap) <= far[who]
            who, box = who[keep], box[keep]
            below = len(boxes[level - 1][0])
            box = (box[:, None] * _WIDTH + np.arange(_WIDTH)).ravel()
            real = box < below
            who, box = np.repeat(who, _WIDTH)[real], box[real]
        lists.append(box)
        counts.append(np.bincount(who, minlength=len(at)))
    count = np.concatenate(counts)
    return np.cumsum(count) - count, count, np.concatenate(lists)


def _smallest(points: Array, queries: Array, begin: Array, count: Array, flat: Array, k: int) -> tuple[Array, Array]:
    """Distances and indices (Q, k) of the nearest among the points flat[begin : begin + count] of each query."""
    distance, index = np.empty((len(queries), k)), np.empty((len(queries), k), np.int64)
    order = np.argsort(count, kind="stable")
    first = 0
    while first < len(order):
        # Rows of about as many candidates, padded to the longest of them.
        last = min(first + max(1, _BATCH // int(count[order[first]])), len(order))
        while last - first > 1 and (last - first) * int(count[order[last - 1]]) > 2 * _BATCH:
            last = first + (last - first) // 2
        rows = order[first:last]
        width = int(count[rows[-1]])
        at = begin[rows, None] + np.arange(width)
        missing = np.arange(width) >= count[rows, None]
        candidate = flat[np.minimum(at, len(flat) - 1)]
        square = np.zeros(candidate.shape)
        for axis in range(3):
            off = np.take(points[:, axis], candidate)
            off -= queries[rows, axis, None]
            off *= off
            square += off
        square[missing] = np.inf
        if k == 1:
            best = square.argmin(axis=1)[:, None]
        else:
            best = np.argpartition(square, k - 1, axis=1)[:, :k] if k < width else np.arange(width)[None]
            best = np.broadcast_to(best, (len(rows), k))
        found = np.take_along_axis(square, best, 1)
        rank = np.argsort(found, axis=1, kind="stable")
        distance[rows] = np.sqrt(np.take_along_axis(found, rank, 1))
        index[rows] = np.take_along_axis(candidate, np.take_along_axis(best, rank, 1), 1)
        first = last
    return distance, index
