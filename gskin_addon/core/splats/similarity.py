# SPDX-License-Identifier: GPL-3.0-or-later
"""What moved a set of points: one similarity, another affine map, or no single map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cloud import Floats

_TOLERANCE = 1e-4
"""Largest residual over the points' size; float32 positions far from the origin lose digits."""


@dataclass(frozen=True)
class Similarity:
    """after = scale * rotation @ before + translation."""

    rotation: NDArray[np.float64]
    scale: float
    translation: NDArray[np.float64]

    @property
    def turns_or_scales(self) -> bool:
        """Whether it is more than a translation."""
        return abs(self.scale - 1.0) > 1e-6 or not np.allclose(self.rotation, np.eye(3), atol=1e-6)


def fit_similarity(before: Floats, after: Floats) -> Similarity | None:
    """The similarity that takes points (N, 3) to points (N, 3); None where none does, or where they leave it open
    (fewer than three, or all on a line).

    Least squares with a proper rotation (Umeyama 1991).
    """
    a, b = np.asarray(before, np.float64), np.asarray(after, np.float64)
    if len(a) < 3:
        return None
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    spread, size = np.linalg.svd(p, compute_uv=False), np.abs(q).max()
    if spread[1] <= 1e-6 * spread[0] or size == 0.0:
        return None
    u, values, vt = np.linalg.svd(q.T @ p)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((values * sign).sum() / (p**2).sum())
    if scale <= 0.0 or np.abs(q - scale * p @ rotation.T).max() > _TOLERANCE * size:
        return None
    return Similarity(rotation, scale, b.mean(axis=0) - scale * rotation @ a.mean(axis=0))


def rigid_part(linear: Floats) -> tuple[NDArray[np.float64], float] | None:
    """Rotation (3, 3) and scale > 0 whose product is `linear` (3, 3); None where there are none."""
    m = np.asarray(linear, np.float64)
    determinant = float(np.linalg.det(m))
    if not determinant > 0.0:
        return None
    scale = determinant ** (1.0 / 3.0)
    rotation = m / scale
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _TOLERANCE:
        return None
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt, scale


def is_affine(before: Floats, after: Floats) -> bool:
    """Whether one affine map takes points (N, 3) to points (N, 3); False where too few (under 6) can tell."""
    a, b = np.asarray(before, np.float64), np.asarray(after, np.float64)
    if len(a) < 6:
        return False
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    linear = np.linalg.lstsq(p, q, rcond=None)[0]
    return bool(np.abs(q - p @ linear).max() <= _TOLERANCE * np.abs(q).max())
