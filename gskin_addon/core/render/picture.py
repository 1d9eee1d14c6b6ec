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
