# SPDX-License-Identifier: GPL-3.0-or-later
"""Weight fields: smooth functions of space whose parameters the optimiser learns."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

PYRAMID = (8, 16, 32, 64)
# Eq. (7) gives far bones weights near 1e-6; their logits must stay within reach of a few Adam steps.
LOG_FLOOR = 1e-4


class SparsePyramid(torch.nn.Module):
    """Residual logits on a sparse voxel pyramid over the log of the initial weights.

    logits(x) = log w_init(x) + sum_l trilinear(theta_l, x), weights = softmax(logits) over the bones.
    Only voxel corners next to a splat are stored. With theta = 0 the weights are the initial ones
    (up to a floor of `LOG_FLOOR`), as the paper's initialisation asks; being trilinear in space is
    what gives the local smoothness that the paper gets from its CNN volume (Sec. III-D).
    """

    def __init__(
        self,
        points: NDArray[Any],
        initial: NDArray[Any],
        resolutions: tuple[int, ...] = PYRAMID,
    ) -> None:
        """points (N, 3) in any unit; initial (N, B) weights with rows that sum to 1."""
        super().__init__()
        matrix, used = trilinear_matrix(points, resolutions)
        index = torch.from_numpy(matrix.indices.astype(np.int64))
        pointer = torch.from_numpy(matrix.indptr.astype(np.int64))
        values = torch.from_numpy(matrix.data.astype(np.float32))
        shape = (len(points), used)
        transposed = matrix.T.tocsr()
        self._matrix = torch.sparse_csr_tensor(pointer, index, values, size=shape)
        self._transposed = torch.sparse_csr_tensor(
            torch.from_numpy(transposed.indptr.astype(np.int64)),
            torch.from_numpy(transposed.indices.astype(np.int64)),
            torch.from_numpy(transposed.data.astype(np.float32)),
            size=shape[::-1],
        )
        floor = np.maximum(np.asarray(initial, np.float64), LOG_FLOOR)
        self._prior = torch.from_numpy(np.log(floor / floor.sum(1, keepdims=True)).astype(np.float32))
        self.theta = torch.nn.Parameter(torch.zeros(used, initial.shape[1]))

    def forward(self) -> torch.Tensor:
        """Weights (N, B) of the splats, rows sum to 1."""
        residual: torch.Tensor = _SparseProduct.apply(  # type: ignore[no-untyped-call]
            self.theta, self._matrix, self._transposed
        )
        return torch.softmax(self._prior + residual, dim=1)


class _SparseProduct(torch.autograd.Function):
    """matrix @ theta for a constant sparse matrix, with its transpose at hand for the backward pass."""

    @staticmethod
    def forward(ctx, theta, matrix, transposed):  # type: ignore[no-untyped-def]
        ctx.transposed = transposed
        return matrix @ theta

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        return ctx.transposed @ grad, None, None


def trilinear_matrix(points: NDArray[Any], resolutions: tuple[int, ...]):  # type: ignore[no-untyped-def]
    """Interpolation weights of every point on every level, columns only for corners that are touched.

    Returns a scipy CSR matrix (N, corners) with 8 values per level in each row, and the number of corners.
    The cube has the points' longest side and is centred on them, so that no axis is favoured.
    """
    from scipy import sparse

    points = np.asarray(points, np.float64)
    # Strays must not stretch the grid: take the bulk and clamp the rest to the border.
    lower, upper = np.percentile(points, [0.1, 99.9], axis=0)
    side = max(float((upper - lower).max()), 1e-12) * 1.02
    unit = np.clip((points - (lower + upper) / 2) / side + 0.5, 0.0, 1.0)
    rows = np.repeat(np.arange(len(points)), 8)
    blocks, used = [], 0
    for resolution in resolutions:
        scaled = unit * (resolution - 1)
        low = np.minimum(scaled.astype(np.int64), resolution - 2)
        part = scaled - low
        corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
        at = low[:, None, :] + corner
        value = np.where(corner, part[:, None, :], 1 - part[:, None, :]).prod(-1)
        key = (at[..., 0] * resolution + at[..., 1]) * resolution + at[..., 2]
        distinct, column = np.unique(key.ravel(), return_inverse=True)
        blocks.append(
            sparse.csr_matrix((value.ravel(), (rows, column.ravel())), shape=(len(points), len(distinct)))
        )
        used += len(distinct)
    return sparse.hstack(blocks, format="csr"), used
