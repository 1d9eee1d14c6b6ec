# SPDX-License-Identifier: GPL-3.0-or-later
"""Connected components of graphs and of voxel grids, in numpy alone."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def connected_components(count: int, first: Array, second: Array) -> NDArray[np.int64]:
    """Label (count,) of the component of every node, which is its smallest node; edges first - second (E,).

    Roots hook under smaller neighbouring roots until no edge leads out of a tree (after Shiloach & Vishkin 1982).
    """
    label = np.arange(count)
    first, second = np.asarray(first, np.int64), np.asarray(second, np.int64)
    while True:
        a, b = label[first], label[second]
        out = a != b
        if not out.any():
            return label
        first, second, a, b = first[out], second[out], a[out], b[out]
        # Where several smaller roots ask for one, any will do: no cycle can arise.
        label[np.maximum(a, b)] = np.minimum(a, b)
        up = label[label]
        while not np.array_equal(up, label):
            label, up = up, up[up]


def unique_edges(edges: Array) -> NDArray[np.int64]:
    """(E, 2): the edges (K, 2) of nodes from 0 on, each once, the smaller node first; ascending."""
    edges = np.sort(np.asarray(edges, np.int64), axis=1)
    # As one number each: numpy sorts rows with Python's lock held, and what waits for that stands still.
    count = int(edges.max(initial=0)) + 1
    return np.stack(np.divmod(np.unique(edges[:, 0] * count + edges[:, 1]), count), axis=1)


def label_voxels(mask: Array) -> tuple[NDArray[np.int32], int]:
    """Components of the True voxels of mask (X, Y, Z) over their 26 neighbours: labels (X, Y, Z) int32, 0 where mask
    is False and counted from 1 elsewhere, and how many there are."""
    inside = np.pad(np.asarray(mask, bool), 1)
    begins = inside & ~np.roll(inside, 1, axis=2)
    # A run of voxels along z is one node. What begins counts up; outside, the count is masked.
    run = np.cumsum(begins.ravel(), dtype=np.int32).reshape(inside.shape)
    runs = int(run.flat[-1])
    run -= 1
    pairs = []
    at = np.flatnonzero(inside)
    flat_run, flat_inside = run.ravel(), inside.ravel()
    stride = (inside.shape[1] * inside.shape[2], inside.shape[2])
    for x, y, z in product((0, 1), (-1, 0, 1), (-1, 0, 1)):
        if (x, y) <= (0, 0):
            continue
        other = at + (x * stride[0] + y * stride[1] + z)
        both = flat_inside[other]
        pairs.append(np.unique(flat_run[at[both]].astype(np.int64) * runs + flat_run[other[both]]))
    pair = np.concatenate(pairs) if runs else np.zeros(0, np.int64)
    root = connected_components(runs, pair // max(runs, 1), pair % max(runs, 1))
    names, number = np.unique(root, return_inverse=True)
    out = np.zeros(inside.shape, np.int32)
    out.reshape(-1)[at] = number.reshape(-1)[flat_run[at]] + 1
    return out[1:-1, 1:-1, 1:-1], len(names)
