# SPDX-License-Identifier: GPL-3.0-or-later
"""A drawn picture of splats with alpha and depth, and what stands in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Picture:
    """Splats over nothing.

    color: (H, W, 3) sRGB multiplied by alpha, as splats are blended; may exceed alpha where harmonics shine above 1.
    alpha: (H, W), 0 to 1.
    depth: (H, W) metres along the camera's z of the splat that takes the transmittance to a half or less;
        inf where none does.
    """

    color: Array
    alpha: Array
    depth: Array

    def over(self, background: tuple[float, float, float]) -> Array:
        """The picture (H, W, 3) over an sRGB colour, blended in sRGB as splats are; clipped to 0..1."""
        behind = (1.0 - self.alpha)[..., None] * np.asarray(background, np.float32)
        return np.asarray(np.clip(self.color + behind, 0.0, 1.0), np.float32)


def to_linear(srgb: Array) -> Array:
    """sRGB decoded to linear light, any shape; values above 1 go on along the curve."""
    dark = np.maximum(srgb, np.float32(0.0)) / np.float32(12.92)
    bright = ((np.maximum(srgb, np.float32(0.04)) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.asarray(np.where(srgb <= 0.04045, dark, bright), np.float32)


def to_srgb(linear: Array) -> Array:
    """Linear light encoded as sRGB, any shape, clipped to 0..1."""
    clipped = np.clip(linear, 0.0, 1.0)
    return np.asarray(np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055), np.float32)
