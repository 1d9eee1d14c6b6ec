# SPDX-License-Identifier: GPL-3.0-or-later
"""The sparse voxel pyramid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from numpy.typing import NDArray

from ...errors import InputError
from .base import WeightField
from .sparse import SparseProduct, trilinear_matrix, unit_cube

PYRAMID = (8, 16, 32, 64)


class SparsePyramid(WeightField):
    """Residual logits on voxel grids of several sizes: residual(x) = sum_l trilinear(theta_l, x).

    Only voxel corners next to a splat are stored. Being trilinear in space is what gives the local
    smoothness that the paper gets from its CNN volume (Sec. III-D), at a small part of the cost.
    """

    def __init__(
        self, points: NDArray[Any], initial: NDArray[Any], resolutions: Sequence[int] = PYRAMID
    ) -> None:
        """points (N, 3) in any unit; initial (N, B) weights with rows that sum to 1."""
        from scipy import sparse

        super().__init__(initial)
        unit = unit_cube(points)
        matrix = sparse.hstack([trilinear_matrix(unit, size)[0] for size in resolutions], format="csr")
        self._interpolate = SparseProduct(matrix)
        self.theta = torch.nn.Parameter(torch.zeros(matrix.shape[1], initial.shape[1]))

    def residual(self) -> torch.Tensor:
        """Logits (N, B) read from the grids."""
        logits: torch.Tensor = self._interpolate(self.theta)
        return logits


def create(points: NDArray[Any], initial: NDArray[Any], resolutions: Sequence[int] = PYRAMID) -> SparsePyramid:
    """See `SparsePyramid`; resolutions: voxels along the longest side, coarse to fine.

    Raises:
        InputError: no resolutions, or one that is not a whole number from 2 up.
    """
    if not resolutions or any(not isinstance(size, int) or size < 2 for size in resolutions):
        raise InputError(f"The pyramid's resolutions are {resolutions!r}; they must be whole numbers from 2 up.")
    return SparsePyramid(points, initial, resolutions)
