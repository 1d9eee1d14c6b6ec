# SPDX-License-Identifier: GPL-3.0-or-later
"""Systems of a graph's Laplacian, solved by conjugate gradients in numpy alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..ticks import Tick, silent

Array = NDArray[Any]

TOLERANCE = 1e-7
"""Largest residual, relative to the diagonal, of an accepted solution."""


class GraphLaplacian:
    """(L x)_i = sum over the edges of i of x_i - x_j."""

    def __init__(self, count: int, edges: Array) -> None:
        """count of nodes; edges (E, 2), each once."""
        source, target = np.concatenate([edges, edges[:, ::-1]]).T
        self.degree = np.bincount(source, minlength=count).astype(np.float64)
        # Nodes by descending degree: the k-th neighbours of all nodes that have one form a block.
        self._order = np.argsort(-self.degree, kind="stable")
        rank = np.empty(count, np.int64)
        rank[self._order] = np.arange(count)
        row, column = rank[source], rank[target]
        by_row = np.lexsort((column, row))
        row, column = row[by_row], column[by_row]
        starts = np.searchsorted(row, np.arange(count))
        number = np.arange(len(row)) - starts[row]
        self._columns = [column[number == k] for k in range(int(self.degree.max(initial=0)))]

    def solve(self, diagonal: Array, right: Array, guess: Array | None = None, tick: Tick = silent) -> Array:
        """x (M, C) with (L + diag(diagonal)) x = right (M, C), diagonal (M,) non-negative and positive somewhere in
        each component of the graph; float64. guess (M, C): the starting point.

        Conjugate gradients with the diagonal as preconditioner, on all columns side by side (Hestenes & Stiefel 1952).
        """
        own = (self.degree + diagonal)[self._order, None]
        x = np.zeros(right.shape) if guess is None else guess[self._order].astype(np.float64)
        right = np.asarray(right, np.float64)[self._order]
        residual = right - self._times(own, x)
        open_ = np.arange(right.shape[1])  # the columns that are not solved yet
        way = np.zeros_like(right)
        before = np.ones(len(open_))
        for turn in range(10 * len(right) + 100):
            bad = np.abs(residual / own).max(axis=0, initial=0) > TOLERANCE
            if not bad.any():
                break
            tick(1 - 1 / (1 + turn / 20))
            if bad.sum() <= 0.75 * len(bad):
                open_, residual, way, before = open_[bad], residual[:, bad], way[:, bad], before[bad]
            ready = residual / own
            now = np.einsum("mc,mc->c", residual, ready)
            way *= now / np.where(before > 0, before, 1)
            way += ready
            product = self._times(own, way)
            step = now / np.maximum(np.einsum("mc,mc->c", way, product), 1e-300)
            x[:, open_] += step * way
            residual = residual - step * product
            before = now
        out = np.empty_like(x)
        out[self._order] = x
        return out

    def _times(self, own: Array, x: Array) -> Array:
        out = own * x
        for column in self._columns:
            some = out[: len(column)]
            np.subtract(some, np.take(x, column, axis=0), out=some)
        return out
