# SPDX-License-Identifier: GPL-3.0-or-later
"""torch.autograd around a prepared scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from .camera import Camera

if TYPE_CHECKING:
    from .rasterizer import Scene


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, scene: Scene, camera: Camera, background: Any) -> Any:
        frame = scene.forward(means.detach().cpu().numpy(), quats.detach().cpu().numpy(), camera, background)
        ctx.scene, ctx.frame = scene, frame
        ctx.like = means, quats
        return torch.from_numpy(frame.image).to(means), torch.from_numpy(frame.alpha).to(means)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        grad_image, grad_alpha = (g.detach().cpu().numpy() for g in grads)
        grad_means, grad_quats = ctx.scene.backward(ctx.frame, grad_image, grad_alpha)
        means, quats = ctx.like
        return (
            torch.from_numpy(grad_means).to(means),
            torch.from_numpy(grad_quats).to(quats),
            None,
            None,
            None,
        )


def rasterize_torch(
    scene: Scene,
    means: Tensor,
    quats: Tensor,
    camera: Camera,
    background: Tensor | ArrayLike = (1.0, 1.0, 1.0),
) -> tuple[Tensor, Tensor]:
    """(image (H,W,3), alpha (H,W)) of a prepared scene, with gradients to means (N,3) and quats (N,4)."""
    back = background.detach().cpu().numpy() if isinstance(background, Tensor) else np.asarray(background)
    image, alpha = _Rasterize.apply(means, quats, scene, camera, back)  # type: ignore[no-untyped-call]
    return image, alpha
