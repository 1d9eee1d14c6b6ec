# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a pose pulls neighbouring splats apart: weights are wrong there, or parts touch that are not one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .body_graph import BodyGraph

Array = NDArray[Any]

NEIGHBOURS = 6
"""Of each splat that are looked at, the nearest first."""
SOFT = 0.005
"""Part of the body's diagonal by which a tear begins to be seen."""


class StretchMeter:
    """Measures poses of splats with means (N, 3) at rest, metres, the graph of their body, and bones index (N, K) with
    weights value (N, K), which sum to 1; index -1 for none.

    Pairs across walls or gaps are no neighbours. To all lengths `SOFT` of the body's diagonal is added: splats lie so
    close that moves which nobody sees would be many times their distance.
    """

    def __init__(self, means: Array, graph: BodyGraph, index: Array, value: Array) -> None:
        count, k = graph.neighbour.shape[0], min(NEIGHBOURS, graph.neighbour.shape[1])
        linked = graph.linked[:, :k]
        first = np.repeat(np.arange(count), k)[linked.ravel()]
        second = graph.neighbour[:, :k][linked]
        # As one number each: rows would be sorted without letting other threads run.
        pairs = np.unique(np.minimum(first, second) * count + np.maximum(first, second))
        self.first, self.second = np.divmod(pairs, count)
        self.means = np.asarray(means, np.float32)
        self.index, self.value = np.asarray(index), np.asarray(value, np.float32)
        self.soft = np.float32(SOFT * float(np.linalg.norm(np.ptp(self.means, axis=0))))
        self.rest = self._lengths(self.means) + self.soft

    def _lengths(self, points: Array) -> Array:
        away = points[self.first] - points[self.second]
        return np.sqrt(np.einsum("ei,ei->e", away, away))

    def posed(self, transforms: Array) -> Array:
        """Means (N, 3) under the bones' transforms (B, 4, 4) (Eq. 1); splats without a bone stay."""
        rows = np.concatenate([transforms[:, :3], np.eye(4)[None, :3]]).astype(np.float32)
        points = np.zeros_like(self.means)
        for slot in range(self.index.shape[1]):
            bone = rows[np.where(self.index[:, slot] >= 0, self.index[:, slot], len(rows) - 1)]
            moved = np.einsum("nij,nj->ni", bone[:, :, :3], self.means) + bone[:, :, 3]
            points += self.value[:, slot, None] * moved
        return points

    def measure(self, transforms: Array) -> Array:
        """(N,) float32: how many times as long as at rest the longest way from each splat to a neighbour is, 1 and
        more, under transforms (B, 4, 4)."""
        times = (self._lengths(self.posed(transforms)) + self.soft) / self.rest
        out = np.ones(len(self.means), np.float32)
        np.maximum.at(out, self.first, times)
        np.maximum.at(out, self.second, times)
        return out
