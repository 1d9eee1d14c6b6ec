# SPDX-License-Identifier: GPL-3.0-or-later
"""Differentiable skinning in torch: Eq. 1 and Eq. 3 with gradients to the weights."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray

from ..rig.lbs import nearest_rotation
from ..rig.quaternion import matrix_to_quat


def quat_multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Hamilton product (..., 4) of wxyz quaternions: the rotation b, then a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def pose_splats(
    means: torch.Tensor, quats: torch.Tensor, weights: torch.Tensor, transforms: NDArray[Any]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Splats under P poses; the same numbers as `rig.lbs.skin_points` and `skin_quats`.

    Args:
        means: (N, 3) rest centres. quats: (N, 4) rest rotations, wxyz. weights: (N, B).
        transforms: (P, B, 4, 4) deform transforms.

    Returns:
        Posed centres (P, N, 3) by Eq. 1, and posed unit rotations (P, N, 4) by Eq. 3 with the signs of the
        bones' quaternions aligned to each splat's dominant bone.
    """
    poses, bones = transforms.shape[:2]
    turns = matrix_to_quat(nearest_rotation(transforms[..., :3, :3]))
    affine = torch.as_tensor(transforms[:, :, :3, :].reshape(poses, bones, 12), dtype=means.dtype).to(means.device)
    blended = (weights @ affine.permute(1, 0, 2).reshape(bones, -1)).view(-1, poses, 3, 4).transpose(0, 1)
    posed = (blended[..., :3] * means[None, :, None, :]).sum(-1) + blended[..., 3]
    with torch.no_grad():
        dominant = weights.argmax(1)
    rotated = []
    for pose in range(poses):
        turn = torch.as_tensor(turns[pose], dtype=means.dtype).to(means.device)
        sign = torch.where(turn @ turn.T < 0, -1.0, 1.0)
        blend = (weights * sign[dominant]) @ turn
        rotated.append(torch.nn.functional.normalize(quat_multiply(blend, quats), dim=-1))
    return posed, torch.stack(rotated)
