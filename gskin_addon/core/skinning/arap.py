# SPDX-License-Identifier: GPL-3.0-or-later
"""As-rigid-as-possible loss on nearest neighbours, with closed-form rotations (fused kernel)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..render.cpu.threads import parallel_for, row_ranges
from .rotations import closest_rotation


@njit(cache=True, nogil=True)
def _kernel(lo, hi, rest, posed, nodes, neighbours, losses, grad):  # type: ignore[no-untyped-def]
    """Poses lo..hi; threads share poses, not nodes, so that each gradient has one writer and one order."""
    K = neighbours.shape[1]
    S, R = np.empty((3, 3)), np.empty((3, 3))
    before, after = np.empty((K, 3)), np.empty((K, 3))
    for p in range(lo, hi):
        total = 0.0
        for n in range(len(nodes)):
            j = nodes[n]
            x0, x1, x2 = rest[j, 0], rest[j, 1], rest[j, 2]
            y0, y1, y2 = posed[p, j, 0], posed[p, j, 1], posed[p, j, 2]
            S[:] = 0.0
            for e in range(K):
                k = neighbours[n, e]
                before[e, 0], before[e, 1], before[e, 2] = rest[k, 0] - x0, rest[k, 1] - x1, rest[k, 2] - x2
                after[e, 0], after[e, 1], after[e, 2] = posed[p, k, 0] - y0, posed[p, k, 1] - y1, posed[p, k, 2] - y2
                for a in range(3):
                    for b in range(3):
                        S[a, b] += after[e, a] * before[e, b]
            closest_rotation(S, R)
            for a in range(3):
                pull = 0.0
                for e in range(K):
                    r = after[e, a] - (R[a, 0] * before[e, 0] + R[a, 1] * before[e, 1] + R[a, 2] * before[e, 2])
                    total += r * r
                    pull += 2 * r
                    grad[p, neighbours[n, e], a] += 2 * r
                grad[p, j, a] -= pull
        losses[p] = total


def arap_loss(
    rest: NDArray[Any],
    posed: NDArray[Any],
    nodes: NDArray[Any],
    neighbours: NDArray[Any],
) -> tuple[float, NDArray[np.float32]]:
    """ARAP loss (paper, Eq. 10) over some nodes, averaged over the poses, and its gradient.

    Args:
        rest: (N, 3) rest positions.
        posed: (P, N, 3) positions under P poses.
        nodes: (M,) the nodes that are summed over (all, or a random subset).
        neighbours: (M, K) their neighbours.

    Returns:
        The loss (unit of the positions squared) and d loss / d posed (P, N, 3). The best rotation is
        itself a minimiser, so it counts as constant in the gradient.
    """
    posed = np.ascontiguousarray(posed, np.float32)
    grad = np.zeros_like(posed)
    losses = np.zeros(len(posed))
    rest = np.ascontiguousarray(rest, np.float32)
    parallel_for(_kernel, row_ranges(len(posed)), rest, posed, nodes, neighbours, losses, grad)
    scale = 1.0 / (2.0 * neighbours.size * len(posed))
    grad *= np.float32(scale)
    return float(losses.sum() * scale), grad
