# SPDX-License-Identifier: GPL-3.0-or-later
"""As-rigid-as-possible loss on nearest neighbours, with closed-form rotations (fused kernel)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..rig.rotations import closest_rotation


@njit(cache=True, parallel=True)
def _kernel(rest, posed, nodes, neighbours, losses, grad):  # type: ignore[no-untyped-def]
    poses, K = posed.shape[0], neighbours.shape[1]
    for p in prange(poses):
        S, R = np.empty((3, 3)), np.empty((3, 3))
        total = 0.0
        for n in range(len(nodes)):
            j = nodes[n]
            S[:] = 0.0
            for e in range(K):
                k = neighbours[n, e]
                for a in range(3):
                    d = posed[p, k, a] - posed[p, j, a]
                    for b in range(3):
                        S[a, b] += d * (rest[k, b] - rest[j, b])
            closest_rotation(S, R)
            for e in range(K):
                k = neighbours[n, e]
                x, y, z = rest[k, 0] - rest[j, 0], rest[k, 1] - rest[j, 1], rest[k, 2] - rest[j, 2]
                for a in range(3):
                    r = posed[p, k, a] - posed[p, j, a] - (R[a, 0] * x + R[a, 1] * y + R[a, 2] * z)
                    total += r * r
                    grad[p, k, a] += 2 * r
                    grad[p, j, a] -= 2 * r
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
    _kernel(np.ascontiguousarray(rest, np.float32), posed, nodes, neighbours, losses, grad)
    scale = 1.0 / (2.0 * neighbours.size * len(posed))
    grad *= np.float32(scale)
    return float(losses.sum() * scale), grad
