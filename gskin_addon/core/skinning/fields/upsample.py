# SPDX-License-Identifier: GPL-3.0-or-later
"""Transposed convolution (kernel 4, stride 2, padding 1), computed only at the requested voxels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .sparse import CORNERS, SparseProduct, flat_key


def sources(at: NDArray[Any]) -> NDArray[np.int64]:
    """The voxels of the coarse grid that each fine voxel reads: (N, 3) -> (N, 8, 3), some outside the grid.

    Fine voxel o = 2 i - 1 + k reads coarse voxel i by kernel tap k in 0..3. Along one axis an even o reads
    i = o/2 (k = 1) and o/2 - 1 (k = 3), an odd one (o - 1)/2 (k = 2) and (o + 1)/2 (k = 0).
    """
    step = np.where(at % 2 == 0, -1, 1)
    read: NDArray[np.int64] = (at // 2)[:, None, :] + step[:, None, :] * CORNERS
    return read


def coarse_places(at: NDArray[Any], coarse: int) -> NDArray[np.int64]:
    """All positions (M, 3) that the fine voxels `at` (N, 3) read in a grid of `coarse` voxels along each axis."""
    read = sources(at).reshape(-1, 3)
    read = read[((read >= 0) & (read < coarse)).all(axis=1)]
    return np.stack(np.unravel_index(np.unique(flat_key(read, coarse)), (coarse,) * 3), axis=1)


class SparseUpsample(torch.nn.Module):
    """ConvTranspose3d(inputs, outputs, 4, stride=2, padding=1) at chosen voxels; the same function.

    A fine voxel reads 8 coarse ones, and which of the 64 kernel taps they meet depends only on whether its
    coordinates are even or odd. So each of the 8 parities is one gather and one matrix product. Near a
    surface a fine grid is nearly empty, which saves most of the work of the dense layer.
    """

    def __init__(self, fine: NDArray[Any], places: NDArray[Any], coarse: int, inputs: int, outputs: int) -> None:
        """fine (N, 3): voxels of the outputs; places (M, 3): voxels of the inputs, in key order."""
        super().__init__()
        # The weights of all taps: by parity of the fine voxel, then source (as in `sources`) and input channel.
        self.weight = torch.nn.Parameter(torch.empty(8, 8 * inputs, outputs))
        self.bias = torch.nn.Parameter(torch.zeros(outputs))
        read = sources(fine)
        inside = ((read >= 0) & (read < coarse)).all(axis=2)
        row = np.searchsorted(flat_key(places, coarse), flat_key(read, coarse))
        row[~inside] = len(places)  # a row of zeros
        parity = (fine % 2) @ (4, 2, 1)
        self.register_buffer("_order", torch.from_numpy(np.argsort(np.argsort(parity, kind="stable"))), False)
        self._order: torch.Tensor
        self._gathers = torch.nn.ModuleList(
            _Gather(row[parity == number].ravel(), len(places)) for number in range(8)
        )

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Inputs (M, inputs) at the coarse voxels -> outputs (N, outputs) at the fine ones."""
        padded = torch.nn.functional.pad(features, (0, 0, 0, 1))
        # Taken apart at once: the gradient of each `weight[number]` would be a whole tensor, zero elsewhere.
        parts = [
            _Taps.apply(padded, weight, gather)  # type: ignore[no-untyped-call]
            for weight, gather in zip(self.weight.unbind(), self._gathers, strict=True)
        ]
        return torch.cat(parts)[self._order] + self.bias


class _Gather(torch.nn.Module):
    """Rows of the padded features in the order of use, 8 for each output, and the inverse index."""

    def __init__(self, rows: NDArray[np.int64], places: int) -> None:
        from scipy import sparse

        super().__init__()
        self.register_buffer("rows", torch.from_numpy(rows), False)
        self.rows: torch.Tensor
        ones = np.ones(len(rows))
        self.add_up = SparseProduct(
            sparse.csr_matrix((ones, (rows, np.arange(len(rows)))), shape=(places + 1, len(rows)))
        )


class _Taps(torch.autograd.Function):
    """padded[rows] @ weight without storing the gathered rows, which take 8 times the memory of the features."""

    @staticmethod
    def forward(ctx, padded, weight, gather):  # type: ignore[no-untyped-def]
        ctx.save_for_backward(padded, weight)
        ctx.gather = gather
        return padded[gather.rows].view(-1, len(weight)) @ weight

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        padded, weight = ctx.saved_tensors
        grad_weight = padded[ctx.gather.rows].view(-1, len(weight)).T @ grad
        grad_padded = ctx.gather.add_up((grad @ weight.T).view(-1, padded.shape[1]))
        return grad_padded, grad_weight, None
