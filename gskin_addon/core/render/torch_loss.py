# SPDX-License-Identifier: GPL-3.0-or-later
"""The image loss of photometric.py as torch operations, for rasterisers on a GPU in torch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from .image_metrics import C1, C2, WINDOW, gaussian_window
from .photometric import PhotometricLoss


def target_tensor(loss: PhotometricLoss, device: torch.device) -> Tensor:
    """The guidance image (H,W,3) in 0..1 on a device; it is uploaded once, as it is stored."""
    key = f"torch {device}"
    if key not in loss.uploaded:
        kind = np.uint8 if loss.target.dtype == np.uint8 else np.float32
        loss.uploaded[key] = torch.from_numpy(np.ascontiguousarray(loss.target, kind)).to(device)
    stored: Tensor = loss.uploaded[key]
    return stored.float() / 255 if stored.dtype == torch.uint8 else stored


def photometric_losses(images: Tensor, losses: Sequence[PhotometricLoss]) -> Tensor:
    """Values (P,) of the losses of images (P,H,W,3), differentiable in the images."""
    targets = torch.stack([target_tensor(loss, images.device) for loss in losses])
    weight = images.new_tensor([loss.weight for loss in losses])
    window = gaussian_window().tolist()

    def along(x: Tensor, axis: int) -> Tensor:
        # Sums of slices, not a convolution: that rounds to ten bits on many GPUs.
        side = [0, 0, WINDOW // 2, WINDOW // 2] if axis == 2 else [0, 0, 0, 0, WINDOW // 2, WINDOW // 2]
        padded, length = pad(x, side), x.shape[axis]
        return sum((w * padded.narrow(axis, k, length) for k, w in enumerate(window)), torch.zeros_like(x))

    def blur(x: Tensor) -> Tensor:
        return along(along(x, 2), 1)

    a, b = images, targets
    ma, mb = blur(a), blur(b)
    saa, sbb, sab = blur(a * a) - ma * ma, blur(b * b) - mb * mb, blur(a * b) - ma * mb
    ssim = ((2 * ma * mb + C1) * (2 * sab + C2)) / ((ma * ma + mb * mb + C1) * (saa + sbb + C2))
    return (1 - weight) * (a - b).abs().mean((1, 2, 3)) + weight * (1 - ssim).mean((1, 2, 3))
