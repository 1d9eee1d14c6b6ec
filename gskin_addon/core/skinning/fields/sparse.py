# SPDX-License-Identifier: GPL-3.0-or-later
"""Constant sparse matrices on voxel grids, and their product with parameters that are learned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
"""(8, 3) offsets of a cell's corners."""


class SparseProduct(torch.nn.Module):
    """matrix @ dense for a constant sparse matrix (rows, columns) and dense (columns, B).

    Both directions are sums of gathered rows in a fixed order, so equal runs give equal bits, and
    `embedding_bag` has tuned kernels for that on the CPU and on CUDA: about half the time of torch's
    sparse CSR product (`benchmarks/bench_fields.py`).
    """

    def __init__(self, matrix: Any) -> None:
        """matrix: a scipy sparse matrix."""
        super().__init__()
        for side, part in (("forward", matrix.tocsr()), ("backward", matrix.T.tocsr())):
            # 32-bit indices take half the memory traffic.
            self.register_buffer(f"_{side}_index", torch.from_numpy(part.indices.astype(np.int32)), False)
            self.register_buffer(f"_{side}_start", torch.from_numpy(part.indptr.astype(np.int32)), False)
            self.register_buffer(f"_{side}_value", torch.from_numpy(part.data.astype(np.float32)), False)

    def forward(self, dense: torch.Tensor) -> torch.Tensor:
        """matrix @ dense, (rows, B), with a gradient to `dense`."""
        product: torch.Tensor = _Product.apply(  # type: ignore[no-untyped-call]
            dense,
            (self._forward_index, self._forward_start, self._forward_value),
            (self._backward_index, self._backward_start, self._backward_value),
        )
        return product


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx, dense, matrix, transposed):  # type: ignore[no-untyped-def]
        ctx.transposed = transposed
        return _sum_rows(dense, *matrix)

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        return _sum_rows(grad.contiguous(), *ctx.transposed), None, None


def _sum_rows(
    dense: torch.Tensor, index: torch.Tensor, start: torch.Tensor, value: torch.Tensor
) -> torch.Tensor:
    return torch.nn.functional.embedding_bag(
        index, dense, start, per_sample_weights=value.to(dense.dtype), mode="sum", include_last_offset=True
    )


@dataclass(frozen=True)
class Cube:
    """A cube around points: middle (3,), side in their unit."""

    middle: NDArray[np.float64]
    side: float

    @classmethod
    def around(cls, points: NDArray[Any]) -> Cube:
        """The cube of the longest extent of points (N, 3).

        The paper puts the lowest corner of the bounding box into the lowest corner of the cube, which leaves all free
        space along the short axes on one side; here the box is centred. Strays must not stretch the cube: it spans the
        0.1 to 99.9 percentiles.
        """
        lower, upper = np.percentile(np.asarray(points, np.float64), [0.1, 99.9], axis=0)
        return cls((lower + upper) / 2, max(float((upper - lower).max()), 1e-12) * 1.02)

    def unit(self, points: NDArray[Any]) -> NDArray[np.float64]:
        """Points (N, 3) in [0, 1]^3; points outside are clamped to the sides."""
        unit: NDArray[np.float64] = np.clip((np.asarray(points, np.float64) - self.middle) / self.side + 0.5, 0.0, 1.0)
        return unit


def unit_cube(points: NDArray[Any]) -> NDArray[np.float64]:
    """Points (N, 3) in a cube [0, 1]^3 with the side of their longest extent; see `Cube`."""
    return Cube.around(points).unit(points)


def corners_and_weights(unit: NDArray[Any], resolution: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Keys (N, 8) of the grid corners around points in the unit cube, and their trilinear weights (N, 8)."""
    scaled = unit * (resolution - 1)
    low = np.minimum(scaled.astype(np.int64), resolution - 2)
    part = scaled - low
    value = np.where(CORNERS, part[:, None, :], 1 - part[:, None, :]).prod(-1)
    return flat_key(low[:, None, :] + CORNERS, resolution), value


def trilinear_matrix(unit: NDArray[Any], resolution: int) -> tuple[Any, NDArray[np.int64]]:
    """Interpolation weights of points in the unit cube on a grid of `resolution` values along each axis.

    The outermost values lie on the cube's sides (grid_sample's align_corners). Returns a scipy CSR matrix
    (N, M) with columns only for the M grid corners next to a point, and their positions (M, 3).
    """
    from scipy import sparse

    key, value = corners_and_weights(unit, resolution)
    distinct, column = np.unique(key.ravel(), return_inverse=True)
    rows = np.repeat(np.arange(len(unit)), 8)
    matrix = sparse.csr_matrix((value.ravel(), (rows, column.ravel())), shape=(len(unit), len(distinct)))
    return matrix, np.stack(np.unravel_index(distinct, (resolution,) * 3), axis=1)


def flat_key(at: NDArray[Any], resolution: int) -> NDArray[np.int64]:
    """Position (..., 3) in a grid as one number, the last axis fastest."""
    key: NDArray[np.int64] = (at[..., 0] * resolution + at[..., 1]) * resolution + at[..., 2]
    return key
