# SPDX-License-Identifier: GPL-3.0-or-later
"""The coupling loss: bones keep their distances to the splats around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..rig.segments import bone_segments
from ..rig.skeleton import Skeleton


@dataclass(frozen=True)
class Coupling:
    """Points on the bones and their nearest splats.

    points (U, 3) at rest; bone (U,) the bone of each; neighbours (U, K) splat indices; distances (U, K).
    """

    points: torch.Tensor
    bone: NDArray[np.int64]
    neighbours: torch.Tensor
    distances: torch.Tensor


def prepare_coupling(
    means: NDArray[Any], skeleton: Skeleton, *, per_bone: int = 8, neighbours: int = 8
) -> Coupling:
    """Sample `per_bone` points on the way of every bone to each joint that hangs on it (`bone_segments`), evenly, and
    find the K_2 = `neighbours` splats nearest to each."""
    from scipy.spatial import cKDTree

    segments = bone_segments(skeleton)
    step = (np.arange(per_bone) + 0.5) / per_bone
    points = segments.starts[:, None] + step[:, None] * (segments.ends - segments.starts)[:, None]
    points = points.reshape(-1, 3)
    distance, index = cKDTree(means).query(points, min(neighbours, len(means)))
    return Coupling(
        torch.as_tensor(points, dtype=torch.float32),
        np.repeat(segments.bone, per_bone),
        torch.as_tensor(index.reshape(len(points), -1)),
        torch.as_tensor(distance.reshape(len(points), -1), dtype=torch.float32),
    )


def coupling_loss(
    coupling: Coupling, posed: torch.Tensor, transforms: NDArray[Any]
) -> torch.Tensor:
    """L_couple (Sec. III-D), averaged over P poses; posed (P, N, 3), transforms (P, B, 4, 4)."""
    matrix = torch.as_tensor(transforms[:, coupling.bone], dtype=posed.dtype)
    moved = (matrix[..., :3, :3] @ coupling.points[None, :, :, None])[..., 0] + matrix[..., :3, 3]
    around = posed[:, coupling.neighbours]  # (P, U, K, 3)
    change = coupling.distances - (moved[:, :, None] - around).square().sum(-1).add(1e-12).sqrt()
    return change.square().mean()
