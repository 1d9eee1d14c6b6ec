# SPDX-License-Identifier: GPL-3.0-or-later
"""Posing, rendering and the image loss on a GPU: in each iteration the weights are uploaded and their gradient
downloaded.

The weight field, ARAP and coupling stay on the CPU; they cost little compared with twenty images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..render.camera import Camera
from ..render.photometric import PhotometricLoss
from ..splats.cloud import SplatCloud
from .posing import pose_splats


@dataclass(frozen=True)
class Views:
    """Images of a batch that share a scene: their places in the batch, cameras and losses."""

    scene: Any
    slots: list[int]
    cameras: list[Camera]
    losses: list[PhotometricLoss]


def tensor_device(scene: Any) -> str | None:
    """torch's name of the device on which a scene takes tensors, if this torch can use it; else None."""
    device: str | None = getattr(scene, "tensor_device", None)
    if device is not None and device.startswith("cuda") and not torch.cuda.is_available():
        return None  # Warp has a GPU, but this torch is for the CPU: arrays are copied
    return device


class DeviceRenderer:
    """Vanilla splats (Eq. 1 and Eq. 3) on a device, their renders and losses."""

    def __init__(self, cloud: SplatCloud, device: str, background: ArrayLike) -> None:
        self._device, self._background = device, background
        self._means, self._quats = (torch.from_numpy(a).to(device) for a in (cloud.means, cloud.quats))

    def __call__(
        self, weights: torch.Tensor, transforms: NDArray[Any], batch: Sequence[Views]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean loss of the batch and posed centres (P, N, 3), both on the CPU and differentiable in the weights.

        weights (N, B) on the CPU; transforms (P, B, 4, 4).
        """
        means, quats = pose_splats(self._means, self._quats, weights.to(self._device), transforms)
        loss: torch.Tensor = _Loss.apply(means, quats, batch, self._background)  # type: ignore[no-untyped-call]
        return loss.to(weights), means.to(weights.device)


class _Loss(torch.autograd.Function):
    """The mean loss of a batch as one node: value and gradients come from the rasteriser together."""

    @staticmethod
    def forward(ctx, means, quats, batch, background):  # type: ignore[no-untyped-def]
        grad_means, grad_quats = torch.empty_like(means), torch.empty_like(quats)
        total = 0.0
        for views in batch:
            values, gm, gq = views.scene.render_and_grad_tensors(
                means[views.slots], quats[views.slots], views.cameras, views.losses, background
            )
            grad_means[views.slots], grad_quats[views.slots] = gm, gq
            total += float(np.sum(values))
        ctx.save_for_backward(grad_means / len(means), grad_quats / len(means))
        return means.new_tensor(total / len(means))

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        grad_means, grad_quats = ctx.saved_tensors
        return grad_means * grad, grad_quats * grad, None, None
