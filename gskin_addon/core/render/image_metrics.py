# SPDX-License-Identifier: GPL-3.0-or-later
"""Image similarity as the splatting literature reports it: PSNR, and SSIM with an 11 x 11 Gaussian window."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

WINDOW = 11
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


def gaussian_window() -> NDArray[np.float64]:
    """The window's 1D profile, (11,), sum 1; the 2D window is its outer product (Wang et al. 2004)."""
    x = np.arange(WINDOW) - WINDOW // 2
    w = np.exp(-(x**2) / (2.0 * SIGMA**2))
    return np.asarray(w / w.sum())


def _pair(a: ArrayLike, b: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if x.shape != y.shape or x.ndim != 3 or x.size == 0:
        raise InputError(f"Images of shapes {x.shape} and {y.shape} cannot be compared; give two (H,W,C) of one size.")
    return x, y


def psnr(a: ArrayLike, b: ArrayLike) -> float:
    """Peak signal-to-noise ratio in dB of images (H,W,C) in 0..1; infinite when they are equal."""
    x, y = _pair(a, b)
    error = float(np.mean((x - y) ** 2))
    return float("inf") if error == 0.0 else -10.0 * float(np.log10(error))


def blur(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Images (H,W,C) under the Gaussian window, zero beyond the edges."""
    w, half = gaussian_window(), WINDOW // 2
    for axis, length in enumerate(image.shape[:2]):
        pad = [(0, 0)] * 3
        pad[axis] = (half, half)
        padded = np.pad(image, pad)
        image = np.asarray(sum(w[k] * padded.take(range(k, k + length), axis) for k in range(WINDOW)))
    return image


def ssim_map(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """SSIM at every pixel and channel, (H,W,C), of images (H,W,C) in 0..1; zero padding, as in 3DGS."""
    x, y = _pair(a, b)
    mx, my = blur(x), blur(y)
    sx, sy, sxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    out: NDArray[np.float64] = ((2 * mx * my + C1) * (2 * sxy + C2)) / ((mx * mx + my * my + C1) * (sx + sy + C2))
    return out


def ssim(a: ArrayLike, b: ArrayLike) -> float:
    """Mean structural similarity of images (H,W,C) in 0..1 (Wang et al. 2004, Eq. 13)."""
    return float(ssim_map(a, b).mean())
