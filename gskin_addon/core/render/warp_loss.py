# SPDX-License-Identifier: GPL-3.0-or-later
"""Warp kernels for the image loss of photometric.py, (1 - w) L1 + w (1 - SSIM), and its gradient, for a batch.

Four passes over whole images: the window along rows, then along columns, of the moments; the same of SSIM's
derivatives. Outside the image everything is zero, as on the CPU.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .image_metrics import C1, C2, WINDOW, gaussian_window
from .photometric import PhotometricLoss
from .warp_blend import Images, Masks
from .warp_project import Floats

wp.set_module_options({"enable_backward": False, "fuse_fp": True})

moments_t = wp.types.vector(length=5, dtype=wp.float32)
window_t = wp.types.vector(length=WINDOW, dtype=wp.float32)

if TYPE_CHECKING:
    Bytes = Moments = Terms = Doubles = Any
else:
    Bytes = wp.array3d(dtype=wp.uint8)
    Moments, Terms = wp.array4d(dtype=moments_t), wp.array4d(dtype=wp.vec3)
    Doubles = wp.array2d(dtype=wp.float64)

_WINDOW, _HALF = wp.constant(WINDOW), wp.constant(WINDOW // 2)
_C1, _C2 = wp.constant(wp.float32(C1)), wp.constant(wp.float32(C2))


@wp.kernel
def unpack_bytes(p: int, source: Bytes, target: Images) -> None:
    """Write an image of bytes (H,W,3) to target[p] in 0..1."""
    y, x, c = wp.tid()
    target[p, y, x, c] = float(source[y, x, c]) / 255.0


@wp.kernel
def blur_moments(image: Images, target: Images, window: window_t, out: Moments) -> None:  # type: ignore[valid-type]
    """The window along rows of a, b, a^2, b^2 and a b."""
    p, y, x, c = wp.tid()
    width = image.shape[2]
    total = moments_t()
    for k in range(_WINDOW):
        at = x + k - _HALF
        if at >= 0 and at < width:
            a = image[p, y, at, c]
            b = target[p, y, at, c]
            total = total + window[k] * moments_t(a, b, a * a, b * b, a * b)
    out[p, y, x, c] = total


@wp.kernel
def ssim_terms(
    moments: Moments, image: Images, target: Images, window: window_t, weights: Floats, terms: Terms, loss: Images,  # type: ignore[valid-type]
) -> None:  # fmt: skip
    """Loss of every pixel and channel, and the derivatives of SSIM that the gradient is made of."""
    p, y, x, c = wp.tid()
    height = image.shape[1]
    m = moments_t()
    for k in range(_WINDOW):
        at = y + k - _HALF
        if at >= 0 and at < height:
            m = m + window[k] * moments[p, at, x, c]
    ma = m[0]
    mb = m[1]
    saa = m[2] - ma * ma
    sbb = m[3] - mb * mb
    sab = m[4] - ma * mb
    a1 = 2.0 * ma * mb + _C1
    a2 = 2.0 * sab + _C2
    b1 = ma * ma + mb * mb + _C1
    b2 = saa + sbb + _C2
    both = 1.0 / (b1 * b2)
    s = a1 * a2 * both
    d_aa = s * b1 * both
    d_ab = 2.0 * a1 * both
    d_a = 2.0 * (mb * a2 * both - ma * s * b2 * both + ma * d_aa) - mb * d_ab
    terms[p, y, x, c] = wp.vec3(d_a, d_aa, d_ab)
    w = weights[p]
    loss[p, y, x, c] = (1.0 - w) * wp.abs(image[p, y, x, c] - target[p, y, x, c]) + w * (1.0 - s)


@wp.kernel
def blur_terms(terms: Terms, window: window_t, out: Terms) -> None:  # type: ignore[valid-type]
    """The window along rows."""
    p, y, x, c = wp.tid()
    width = terms.shape[2]
    total = wp.vec3()
    for k in range(_WINDOW):
        at = x + k - _HALF
        if at >= 0 and at < width:
            total = total + window[k] * terms[p, y, at, c]
    out[p, y, x, c] = total


@wp.kernel
def loss_gradient(
    terms: Terms, image: Images, target: Images, window: window_t, weights: Floats, scale: float, grad: Images,  # type: ignore[valid-type]
) -> None:  # fmt: skip
    """The window along columns, and scale x gradient of the loss to the image."""
    p, y, x, c = wp.tid()
    height = image.shape[1]
    total = wp.vec3()
    for k in range(_WINDOW):
        at = y + k - _HALF
        if at >= 0 and at < height:
            total = total + window[k] * terms[p, at, x, c]
    a = image[p, y, x, c]
    b = target[p, y, x, c]
    side = float(0.0)
    if a > b:
        side = 1.0
    if a < b:
        side = -1.0
    w = weights[p]
    grad[p, y, x, c] = scale * ((1.0 - w) * side - w * (total[0] - 2.0 * a * total[1] + b * total[2]))


@wp.kernel
def sum_rows(loss: Images, out: Doubles) -> None:
    """out (P,H): sums over a row's pixels and channels, in a fixed order."""
    p, y = wp.tid()
    total = wp.float64(0.0)
    for x in range(loss.shape[2]):
        total = total + wp.float64(loss[p, y, x, 0] + loss[p, y, x, 1] + loss[p, y, x, 2])
    out[p, y] = total


def upload_target(loss: PhotometricLoss, device: Any) -> Any:
    """The guidance image of a loss on the device, (H,W,3) of bytes or floats; kept with the loss."""
    kept = loss.uploaded.get(str(device))
    if kept is None:
        kind = wp.uint8 if loss.target.dtype == np.uint8 else wp.float32
        image = np.ascontiguousarray(loss.target, np.uint8 if kind is wp.uint8 else np.float32)
        kept = loss.uploaded[str(device)] = wp.array(image, dtype=kind, device=device)
    return kept


def loss_and_gradient(image: Any, losses: list[PhotometricLoss], device: Any) -> tuple[Any, Any]:
    """Sums over rows (P,H) of the losses times 3 H W, and the gradients (P,H,W,3), of images (P,H,W,3)."""
    shape = poses, height, width, channels = image.shape
    target = wp.empty(shape, dtype=wp.float32, device=device)
    for p, loss in enumerate(losses):
        source = upload_target(loss, device)
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
