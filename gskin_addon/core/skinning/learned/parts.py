# SPDX-License-Identifier: GPL-3.0-or-later
"""Which splats belong together: neighbours, touching pieces, and regions of one colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.nearest_points import nearest_points
from ...splats.components import connected_components
from ...ticks import Tick, silent
from ..walls import blocked, nearest_open

Array = NDArray[Any]

NEAR = ((500, 5), (200, 12))
"""Neighbourhoods: (size of the even subset that stands for the object, its nearest members to average)."""

COLOUR_SCALES = (1e-4, 1.2e-3)
"""Tight and loose: a region of this share of all splats may still take a colour step of 1."""

TOUCH = 3.0
"""Splats this many usual steps apart touch: hardly one is farther than that from all of its neighbours."""

LINKS = 10
_APART = 2.0  # see GAP_RATIO in core/skinning/node_graph.py
_ROWS = 4096  # pairs times bones at a time: small enough for the processor's cache


@dataclass(frozen=True)
class Parts:
    """near: one (N, k) array of splat indices for each of `NEAR`; labels (N, 3) int32: piece, tight and loose
    colour region of each splat, counted from 0 in each column."""

    near: tuple[Array, ...]
    labels: Array

    def pooled(self, values: Array) -> list[Array]:
        """Means of `values` (N, C) over the neighbourhoods, then over the labels: 5 arrays (N, C)."""
        out = [values[near].mean(axis=1) for near in self.near]
        for label in self.labels.T:
            out.append(label_means(values, label)[label])
        return out


def label_means(values: Array, label: Array) -> Array:
    """(L, C): mean of the rows of `values` (N, C) with each label (N,)."""
    size = np.bincount(label)
    order = np.argsort(label, kind="stable")
    present = np.flatnonzero(size)
    starts = (np.cumsum(size) - size)[present]
    out = np.zeros((len(size), values.shape[1]), np.float32)
    out[present] = np.add.reduceat(values[order], starts, axis=0) / size[present, None]
    return out


def find_parts(
    points: Array,
    colors: Array,
    profile: Array,
    *,
    links: int = LINKS,
    around: tuple[Array, Array] | None = None,
    walls: Array | None = None,
) -> Parts:
    """The parts of an object.

    points (N, 3); colors (N, 3) in [0, 1]; profile (N, B): distances to the bones through the body. Neighbours
    whose profiles differ much more than the way between them sit on either side of a gap and are not linked, nor
    those with a wall between them; walls (N,): labels. around: distances and indices (N, > links) of each splat's
    nearest, itself included, where they are known.
    """
    count = len(points)
    points = np.ascontiguousarray(points, np.float64)
    profile = np.ascontiguousarray(profile, np.float32)
    k = min(links + 1, count)
    way, index = around or nearest_points(points, points, k)
    way, index = way[:, 1:k], index[:, 1:k]
    pitch = float(np.median(way)) if way.size else 1.0
    open_way = ~apart(index, way, profile, walls=walls)
    a, k_ = np.nonzero(open_way & (way < TOUCH * pitch))
    b = index[a, k_]
    pieces = connected_components(count, a, b)
    step = np.linalg.norm(colors[a] - colors[b], axis=1).astype(np.float32)
    order = np.argsort(step, kind="stable")
    regions = [_grow_regions(a[order], b[order], step[order], count, scale) for scale in COLOUR_SCALES]
    near = neighbourhoods(points, profile, walls)
    labels = [np.unique(label, return_inverse=True)[1].reshape(-1) for label in (pieces, *regions)]
    return Parts(near, np.stack(labels, axis=1).astype(np.int32))


def neighbourhoods(points: Array, profile: Array, walls: Array | None = None) -> tuple[Array, ...]:
    """One (N, k) array of indices for each of `NEAR`."""
    return tuple(_neighbourhood(points, profile, size, k, walls) for size, k in NEAR)


def _neighbourhood(points: Array, profile: Array, size: int, k: int, walls: Array | None) -> Array:
    """(N, k) indices of the nearest members of an even subset; the nearest one in place of those over a gap."""
    members = even_subset(points, size)
    k = min(k, len(members))
    way, at = nearest_points(points[members], points, k)
    index = members[at].astype(np.int32)
    beyond = apart(index, way, profile, walls=walls)
    first = np.argmin(beyond, axis=1)  # the nearest on this side; where there is none, the nearest
    if walls is not None:
        lost = np.flatnonzero(beyond.all(axis=1))
        index[lost, 0] = members[nearest_open(points[members], points[lost], walls[members], walls[lost])[1]]
    return np.where(beyond, np.take_along_axis(index, first[:, None], 1), index)


def even_subset(points: Array, count: int, tick: Tick = silent) -> Array:
    """About `count` well spread points, one of each voxel of a grid: indices, ascending."""
    if len(points) <= count:
        return np.arange(len(points))
    lower, upper = np.percentile(points, [0.5, 99.5], axis=0)
    side = float((upper - lower).max()) or 1.0
    low, high = 1.0, 4096.0
    best: Array = np.arange(min(count, len(points)))
    for turn in range(12):
        tick(turn / 12)
        middle = float(np.sqrt(low * high))
        cells = np.floor((points - lower) / side * middle).astype(np.int64).clip(-8192, 8191) + 8192
        key = (cells[:, 0] * 16384 + cells[:, 1]) * 16384 + cells[:, 2]
        taken = np.unique(key, return_index=True)[1]
        low, high = (middle, high) if len(taken) < count else (low, middle)
        best = taken
        if abs(len(taken) - count) < 0.02 * count:
            break
    return np.sort(best)


def apart(
    index: Array,
    way: Array,
    profile: Array,
    *,
    rows: Array | None = None,
    pitch: float | None = None,
    walls: Array | None = None,
) -> Array:
    """(N, k) bool: no body lies between point n (or rows[n]) and point index[n, k], `way` apart; their distances to
    some bone, profile (M, B), differ by more than that way allows, or a wall of walls (M,) is between. pitch: the
    least way that counts; the median of `way` unless given."""
    rows = np.arange(len(index)) if rows is None else rows
    if pitch is None:
        pitch = float(np.median(way)) if way.size else 1.0
    limit = np.float32(_APART) * np.maximum(np.asarray(way, np.float32), np.float32(pitch))
    profile = np.ascontiguousarray(profile, np.float32)
    out = np.zeros(index.shape, bool)
    step = max(1, _ROWS * 64 // (max(index.shape[1], 1) * profile.shape[1]))
    for first in range(0, len(index), step):
        some = slice(first, first + step)
        jump = profile[index[some]]
        jump -= profile[rows[some], None]
        out[some] = np.abs(jump, out=jump).max(axis=2, initial=0) > limit[some]
    if walls is not None:
        out |= blocked(walls[rows][:, None], walls[index])
    return out


def _grow_regions(a: Array, b: Array, step: Array, count: int, scale: float) -> Array:
    """Labels (N,) after Felzenszwalb & Huttenlocher 2004; edges (a, b) by ascending colour step.

    The size of a region counts as its share of all splats, so that the result does not hang on their number.
    """
    parent = list(range(count))
    # How large a step a region may take: its largest one so far, and more the smaller it is.
    size, bound = [1] * count, [scale * count] * count

    def root(n: int) -> int:
        while parent[n] != n:
            parent[n] = n = parent[parent[n]]
        return n

    for p, q, height in zip(a.tolist(), b.tolist(), step.tolist(), strict=True):
        p, q = root(p), root(q)
        if p != q and height <= bound[p] and height <= bound[q]:
            if size[p] < size[q]:
                p, q = q, p
            parent[q] = p
            size[p] += size[q]
            bound[p] = height + scale * count / size[p]  # steps ascend: this is the largest so far
    return np.array([root(n) for n in range(count)])
