# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses of a batch of images on a Warp device: photometric ones by its kernels, others by fetching the images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ..cpu.backend import ImageLoss
from ..image_metrics import gaussian_window
from ..photometric import PhotometricLoss
from .loss_kernels import (
    blur_moments,
    blur_terms,
    loss_gradient,
    moments_t,
    ssim_terms,
    sum_rows,
    unpack_bytes,
    window_t,
)


def image_losses(image: Any, alpha: Any, losses: Sequence[ImageLoss]) -> tuple[NDArray[np.float64], Any]:
    """Values (P,) and the gradient to the images (P,H,W,3), on the device."""
    device, shape = image.device, image.shape
    photometric = [loss for loss in losses if isinstance(loss, PhotometricLoss)]
    if len(photometric) == len(losses):
        for loss in photometric:
            loss.check(shape[1:])
        rows, grad = _loss_and_gradient(image, photometric)
        return rows.numpy().sum(axis=1) / np.prod(shape[1:]), grad
    pairs = [loss(*view) for loss, *view in zip(losses, image.numpy(), alpha.numpy(), strict=True)]
    grads = np.stack([np.asarray(grad, np.float32) for _, grad in pairs])
    return np.array([value for value, _ in pairs], np.float64), wp.array(grads, dtype=wp.float32, device=device)


def _upload_target(loss: PhotometricLoss, device: Any) -> Any:
    """The guidance image of a loss on the device, (H,W,3) of bytes or floats; kept with the loss."""
    kept = loss.uploaded.get(str(device))
    if kept is None:
        kind = wp.uint8 if loss.target.dtype == np.uint8 else wp.float32
        image = np.ascontiguousarray(loss.target, np.uint8 if kind is wp.uint8 else np.float32)
        kept = loss.uploaded[str(device)] = wp.array(image, dtype=kind, device=device)
    return kept


def _loss_and_gradient(image: Any, losses: list[PhotometricLoss]) -> tuple[Any, Any]:
    """Sums over rows (P,H) of the losses times 3 H W, and the gradients (P,H,W,3), of images (P,H,W,3)."""
    device, shape = image.device, image.shape
    poses, height, width, channels = shape
    target = wp.empty(shape, dtype=wp.float32, device=device)
    for p, loss in enumerate(losses):
        source = _upload_target(loss, device)
        if source.dtype is wp.uint8:
            wp.launch(unpack_bytes, (height, width, channels), [p, source, target], device=device)
        else:
            wp.copy(target[p], source)
    window = window_t(*gaussian_window())
    weights = wp.array([loss.weight for loss in losses], dtype=wp.float32, device=device)
    moments = wp.empty(shape, dtype=moments_t, device=device)
    terms, blurred = (wp.empty(shape, dtype=wp.vec3, device=device) for _ in range(2))
    grad, each = (wp.empty(shape, dtype=wp.float32, device=device) for _ in range(2))
    rows = wp.empty((poses, height), dtype=wp.float64, device=device)
    wp.launch(blur_moments, shape, [image, target, window, moments], device=device)
    wp.launch(ssim_terms, shape, [moments, image, target, window, weights, terms, each], device=device)
    wp.launch(blur_terms, shape, [terms, window, blurred], device=device)
    scale = 1.0 / (height * width * channels)
    wp.launch(loss_gradient, shape, [blurred, image, target, window, weights, scale, grad], device=device)
    wp.launch(sum_rows, (poses, height), [each, rows], device=device)
    return rows, grad
