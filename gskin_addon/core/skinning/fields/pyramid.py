# SPDX-License-Identifier: GPL-3.0-or-later
"""The sparse voxel pyramid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .base import WeightField
from .sparse import Cube, SparseProduct, corners_and_weights, flat_key, trilinear_matrix

PYRAMID = (8, 16, 32, 64)
STORED = 0.5
"""Least trilinear weight of the stored corners at which a point counts as known."""


class SparsePyramid(WeightField):
    """Residual logits on voxel grids of several sizes: residual(x) = sum_l trilinear(theta_l, x).

    Only voxel corners next to a splat are stored. Being trilinear in space is what gives the local
    smoothness that the paper gets from its CNN volume (Sec. III-D), at a fraction of the cost.
    """

    def __init__(
        self, points: NDArray[Any], initial: NDArray[Any], resolutions: Sequence[int] = PYRAMID
    ) -> None:
        """points (N, 3) in any unit; initial (N, B) weights with rows that sum to 1."""
        from scipy import sparse

        super().__init__(initial)
        self._cube = Cube.around(points)
        unit = self._cube.unit(points)
        parts = [trilinear_matrix(unit, size) for size in resolutions]
        matrix = sparse.hstack([part for part, _ in parts], format="csr")
        self._interpolate = SparseProduct(matrix)
        self._levels = [(size, flat_key(at, size)) for size, (_, at) in zip(resolutions, parts, strict=True)]
        self.theta = torch.nn.Parameter(torch.zeros(matrix.shape[1], initial.shape[1]))

    def residual(self) -> torch.Tensor:
        """Logits (N, B) read from the grids."""
        logits: torch.Tensor = self._interpolate(self.theta)
        return logits

    def query(self, points: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Learned logits (M, B) at points (M, 3), known (M,): where most of the surrounding corners are stored in each
        grid."""
        unit = self._cube.unit(points)
        theta = self.theta.detach().numpy()
        logits, known = np.zeros((len(points), theta.shape[1]), np.float32), np.ones(len(points), bool)
        first = 0
        for size, keys in self._levels:
            key, value = corners_and_weights(unit, size)
            place = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
            value = np.where(keys[place] == key, value, 0.0)
            stored = value.sum(axis=1)
            known &= stored >= STORED
            share = (value / np.maximum(stored, 1e-9)[:, None]).astype(np.float32)
            for corner in range(8):
                logits += share[:, corner, None] * theta[first + place[:, corner]]
            first += len(keys)
        return logits, known


def create(points: NDArray[Any], initial: NDArray[Any], resolutions: Sequence[int] = PYRAMID) -> SparsePyramid:
    """See `SparsePyramid`; resolutions: voxels along the longest side, coarse to fine; see `check_options`."""
    return SparsePyramid(points, initial, resolutions)
