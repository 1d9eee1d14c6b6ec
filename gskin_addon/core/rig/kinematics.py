# SPDX-License-Identifier: GPL-3.0-or-later
"""Forward kinematics (Eq. 2): from a pose's rotations to deform transforms in world space."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .skeleton import Skeleton

Array = NDArray[Any]


def pose_transforms(skeleton: Skeleton, rotations: Array, translation: Array | None = None) -> Array:
    """Deform transforms P_b = P_parent [R_b, h_b - R_b h_b] (Eq. 2), h_b the bone's head at rest.

    rotations (P, B, 3, 3): the rotation each bone adds to its parent's, in world axes, about its head.
    translation (P, 3) or None moves the roots. Returns (P, B, 4, 4) float64, which equal pose x inverse(rest)
    in world space and map rest points to posed points. Leading shape (B, 3, 3) gives (B, 4, 4).
    """
    rotations = np.asarray(rotations, dtype=np.float64)
    if rotations.shape[-3:] != (skeleton.count, 3, 3) or rotations.ndim not in (3, 4):
        raise ValueError(f"rotations have shape {rotations.shape}, expected (P, {skeleton.count}, 3, 3)")
    single = rotations.ndim == 3
    rotations = rotations[None] if single else rotations
    local = np.zeros((*rotations.shape[:2], 4, 4))
    local[..., :3, :3] = rotations
    local[..., :3, 3] = skeleton.heads - np.einsum("pbij,bj->pbi", rotations, skeleton.heads)
    local[..., 3, 3] = 1
    out = np.empty_like(local)
    for bone, parent in enumerate(skeleton.parents):
        if parent < 0:
            out[:, bone] = local[:, bone]
            if translation is not None:
                out[:, bone, :3, 3] += np.asarray(translation, dtype=np.float64).reshape(-1, 3)
        else:
            out[:, bone] = out[:, parent] @ local[:, bone]
    return out[0] if single else out


def joints_posed(skeleton: Skeleton, transforms: Array) -> tuple[Array, Array]:
    """Posed heads and tails, each (..., B, 3), under deform transforms (..., B, 4, 4)."""
    transforms = np.asarray(transforms, dtype=np.float64)
    rotation, shift = transforms[..., :3, :3], transforms[..., :3, 3]
    heads = np.einsum("...bij,bj->...bi", rotation, skeleton.heads) + shift
    tails = np.einsum("...bij,bj->...bi", rotation, skeleton.tails) + shift
    return heads, tails
