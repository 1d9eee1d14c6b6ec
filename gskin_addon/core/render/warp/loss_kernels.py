# SPDX-License-Identifier: GPL-3.0-or-later
"""Warp kernels for the image loss of photometric.py, (1 - w) L1 + w (1 - SSIM), and its gradient, for a batch.

Four passes over whole images: the window along rows, then along columns, of the moments; the same of SSIM's
derivatives. Outside the image everything is zero, as on the CPU.
"""

from __future__ import annotations

import warp as wp

from ..image_metrics import C1, C2, WINDOW
from .blend import Images
from .project import Floats

wp.set_module_options({"enable_backward": False})

moments_t = wp.types.vector(length=5, dtype=wp.float32)
window_t = wp.types.vector(length=WINDOW, dtype=wp.float32)

Bytes, Doubles = wp.array3d(dtype=wp.uint8), wp.array2d(dtype=wp.float64)
Moments, Terms = wp.array4d(dtype=moments_t), wp.array4d(dtype=wp.vec3)

_WINDOW, _HALF = wp.constant(WINDOW), wp.constant(WINDOW // 2)
_C1, _C2 = wp.constant(wp.float32(C1)), wp.constant(wp.float32(C2))


@wp.kernel
def unpack_bytes(p: int, source: Bytes, target: Images) -> None:
    """Write an image of bytes (H,W,3) to target[p] in 0..1."""
    y, x, c = wp.tid()
    target[p, y, x, c] = float(source[y, x, c]) / 255.0


@wp.kernel
def blur_moments(image: Images, target: Images, window: window_t, out: Moments) -> None:
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
    moments: Moments, image: Images, target: Images, window: window_t, weights: Floats, terms: Terms, loss: Images,
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
def blur_terms(terms: Terms, window: window_t, out: Terms) -> None:
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
    terms: Terms, image: Images, target: Images, window: window_t, weights: Floats, scale: float, grad: Images,
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
