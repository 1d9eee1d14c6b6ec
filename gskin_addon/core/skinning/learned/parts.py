# SPDX-License-Identifier: GPL-3.0-or-later
"""Which splats belong together: neighbours, touching pieces, and regions of one colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

NEAR = ((500, 5), (200, 12))
"""Neighbourhoods: (size of the even subset that stands for the object, its nearest members to average)."""

COLOUR_SCALES = (1e-4, 1.2e-3)
"""Tight and loose: a region of this share of all splats may still take a colour step of 1."""

TOUCH = 3.0
"""Splats this many usual steps apart touch: hardly one is farther than that from all of its neighbours."""

LINKS = 10
_APART = 2.0  # see GAP_RATIO in core/skinning/node_graph.py


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
    from scipy import sparse

    size = np.bincount(label)
    member = sparse.csr_matrix((np.ones(len(label), np.float32), (label, np.arange(len(label)))))
    return np.asarray(member @ values, np.float32) / np.maximum(size, 1)[:, None]


def find_parts(points: Array, colors: Array, profile: Array, *, links: int = LINKS) -> Parts:
    """The parts of an object.

    points (N, 3); colors (N, 3) in [0, 1]; profile (N, B): distances to the bones through the body. Neighbours
    whose profiles differ much more than the way between them sit on either side of a gap and are not linked.
    """
    from scipy.spatial import cKDTree

    count = len(points)
    points = np.ascontiguousarray(points, np.float64)
    profile = np.ascontiguousarray(profile, np.float32)
    way, index = cKDTree(points).query(points, min(links + 1, count))
    way, index = way.reshape(count, -1)[:, 1:], index.reshape(count, -1)[:, 1:].astype(np.int32)
    pitch = float(np.median(way)) if way.size else 1.0
    open_way = ~apart(index, way, profile)
    a, k = np.nonzero(open_way & (way < TOUCH * pitch))
    b = index[a, k]
    pieces = connected(count, a, b)
    step = np.linalg.norm(colors[a] - colors[b], axis=1).astype(np.float32)
    order = np.argsort(step, kind="stable")
    regions = [_grow_regions(a[order], b[order], step[order], count, scale) for scale in COLOUR_SCALES]
    near = neighbourhoods(points, profile)
    labels = [np.unique(label, return_inverse=True)[1] for label in (pieces, *regions)]
    return Parts(near, np.stack(labels, axis=1).astype(np.int32))


def connected(count: int, a: Array, b: Array) -> Array:
    """(count,) labels of the pieces that links between a and b (E,) make."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    links = sparse.coo_matrix((np.ones(len(a)), (a, b)), (count, count))
    label: Array = connected_components(links, directed=False)[1]
    return label


def neighbourhoods(points: Array, profile: Array) -> tuple[Array, ...]:
    """One (N, k) array of indices for each of `NEAR`."""
    return tuple(_neighbourhood(points, profile, size, k) for size, k in NEAR)


def _neighbourhood(points: Array, profile: Array, size: int, k: int) -> Array:
    """(N, k) indices of the nearest members of an even subset; the nearest one in place of those over a gap."""
    from scipy.spatial import cKDTree

    members = even_subset(points, size)
    k = min(k, len(members))
    way, at = cKDTree(points[members]).query(points, k)
    way, at = way.reshape(len(points), -1), at.reshape(len(points), -1)
    index = members[at].astype(np.int32)
    beyond = apart(index, way, profile)
    first = np.argmin(beyond, axis=1)  # the nearest on this side; where there is none, the nearest
    return np.where(beyond, np.take_along_axis(index, first[:, None], 1), index)


def even_subset(points: Array, count: int) -> Array:
    """About `count` well spread points, one of each voxel of a grid: indices, ascending."""
    if len(points) <= count:
        return np.arange(len(points))
    lower = np.percentile(points, 0.5, axis=0)
    side = float(np.ptp(np.percentile(points, [0.5, 99.5], axis=0), axis=0).max()) or 1.0
    low, high = 1.0, 4096.0
    best: Array = np.arange(min(count, len(points)))
    for _ in range(12):
        middle = float(np.sqrt(low * high))
        cells = np.floor((points - lower) / side * middle).astype(np.int64).clip(-8192, 8191) + 8192
        key = (cells[:, 0] * 16384 + cells[:, 1]) * 16384 + cells[:, 2]
        taken = np.unique(key, return_index=True)[1]
        low, high = (middle, high) if len(taken) < count else (low, middle)
        best = taken
        if abs(len(taken) - count) < 0.02 * count:
            break
    return np.sort(best)


def apart(index: Array, way: Array, profile: Array, *, rows: Array | None = None) -> Array:
    """(N, k) bool: no body lies between point n (or rows[n]) and point index[n, k], `way` apart; their distances to
    some bone, profile (M, B), differ by more than that way allows."""
    profile = np.ascontiguousarray(profile, np.float32)
    rows = np.arange(len(index)) if rows is None else rows
    pitch = np.float32(np.median(way)) if way.size else np.float32(1)
    return _apart_kernel(index, np.ascontiguousarray(way, np.float32), profile, rows, pitch)


@njit(cache=True)
def _apart_kernel(index, way, profile, rows, pitch):  # type: ignore[no-untyped-def]
    out = np.zeros(index.shape, np.bool_)
    for n in range(index.shape[0]):
        own = profile[rows[n]]
        for k in range(index.shape[1]):
            limit = _APART * max(way[n, k], pitch)
            other = profile[index[n, k]]
            for b in range(profile.shape[1]):
                if abs(own[b] - other[b]) > limit:
                    out[n, k] = True
                    break
    return out


@njit(cache=True)
def _root(parent, n):  # type: ignore[no-untyped-def]
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


@njit(cache=True)
def _grow_regions(a, b, step, count, scale):  # type: ignore[no-untyped-def]
    """Labels (N,) after Felzenszwalb & Huttenlocher 2004; edges (a, b) by ascending colour step.

    The size of a region counts as its share of all splats, so that the result does not hang on their number.
    """
    parent = np.arange(count)
    size = np.ones(count)
    inner = np.zeros(count, np.float32)
    for e in range(len(a)):
        p, q = _root(parent, a[e]), _root(parent, b[e])
        if p == q:
            continue
        if step[e] <= min(inner[p] + scale * count / size[p], inner[q] + scale * count / size[q]):
            if size[p] < size[q]:
                p, q = q, p
            parent[q] = p
            size[p] += size[q]
            inner[p] = max(inner[p], inner[q], step[e])
    for n in range(count):
        parent[n] = _root(parent, n)
    return parent
