# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians under linear maps: T Sigma T^T as a rotation and scales again. numpy only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .quaternion import matrix_to_quat, quat_to_matrix

Array = NDArray[Any]

SWEEPS = 12
THINNEST = 1e-9
"""A flat splat's thickness, relative to its longest axis, while its axes are being found."""


def transform_gaussians(quats: Array, scales: Array, maps: Array) -> tuple[Array, Array]:
    """Gaussians with covariance T Sigma T^T, Sigma = Q diag(scales^2) Q^T.

    quats (N, 4) wxyz, scales (N, 3), maps T (N, 3, 3) -> unit quats (N, 4), scales (N, 3), float64. Axis k of the
    result comes from axis k before: a map that keeps the axes orthogonal keeps their order. Exact for thin
    splats too, because T Q diag(scales) is decomposed and not its square. A splat without size stays one.
    """
    scales = np.asarray(scales, dtype=np.float64)
    longest = scales.max(axis=1, keepdims=True)
    safe = np.maximum(scales, THINNEST * np.where(longest > 0, longest, 1))
    columns = np.asarray(maps, dtype=np.float64) @ (quat_to_matrix(np.asarray(quats, np.float64)) * safe[:, None, :])
    axes, lengths = orthogonal_axes(columns)
    return matrix_to_quat(axes), np.where(scales > 0, lengths, 0.0)


def orthogonal_axes(columns: Array) -> tuple[Array, Array]:
    """Principal axes (N, 3, 3), in columns, and lengths (N, 3) of M M^T for M = `columns` (N, 3, 3).

    One-sided Jacobi: turns pairs of columns by at most 45 degrees until all are orthogonal, so each axis stays
    next to the column it began as. The axes are rotations (determinant 1).
    """
    axis = [np.array(columns[:, :, k], dtype=np.float64) for k in range(3)]
    for _ in range(SWEEPS):
        worst = 0.0
        for p, q in ((0, 1), (0, 2), (1, 2)):
            a, b = axis[p], axis[q]
            aa, bb, ab = (np.einsum("ij,ij->i", x, y) for x, y in ((a, a), (b, b), (a, b)))
            size = np.sqrt(aa * bb)
            cosine = np.abs(ab) / np.where(size > 0, size, 1)
            worst = max(worst, float(cosine.max(initial=0)))
            # t = tan of the angle; this form needs no division by ab, which may be zero.
            difference = bb - aa
            twice = 2 * np.abs(ab)
            root = np.abs(difference) + np.sqrt(difference * difference + twice * twice)
            sign = np.where(difference >= 0, 1.0, -1.0) * np.where(ab >= 0, 1.0, -1.0)
            t = sign * twice / np.where(root > 0, root, 1)
            c = 1 / np.sqrt(1 + t * t)
            s = c * t
            axis[p], axis[q] = c[:, None] * a - s[:, None] * b, s[:, None] * a + c[:, None] * b
        if worst < 1e-14:
            break
    lengths = np.stack([np.linalg.norm(a, axis=1) for a in axis], axis=1)
    return _complete(np.stack(axis, axis=2), lengths), lengths


def _complete(axes: Array, lengths: Array) -> Array:
    """Unit, right-handed columns; those without a direction are made up from the others."""
    longest = lengths.max(axis=1, keepdims=True)
    known = lengths > 1e-14 * longest
    unit = np.where(known[:, None, :], axes / np.where(known, lengths, 1)[:, None, :], 0)
    for row in np.flatnonzero(~known.all(axis=1)):
        # Left singular vectors complete the basis; known columns are orthonormal and are put back.
        u, _, _ = np.linalg.svd(unit[row])
        free = [k for k in range(3) if not known[row, k]]
        spare = u[:, 3 - len(free) :]
        unit[row][:, free] = spare
    flip = np.linalg.det(unit) < 0
    # The last, or the made-up axis may point either way: the covariance does not see it.
    unit[flip, :, 2] *= -1
    return unit
