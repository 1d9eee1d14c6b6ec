# SPDX-License-Identifier: GPL-3.0-or-later
"""One colour per bone, for pictures of weights."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_GOLDEN = 0.6180339887498949


def bone_colors(count: int) -> Array:
    """(count, 3) sRGB in 0..1; hues go round by the golden ratio, so that neighbours in the list differ."""
    hue = (np.arange(count) * _GOLDEN + 0.02) % 1.0
    value = np.where(np.arange(count) % 2 == 0, 0.95, 0.78)
    saturation = np.where(np.arange(count) % 3 == 1, 0.55, 0.80)
    wheel = np.clip(np.abs((hue[:, None] * 6 + [0, 4, 2]) % 6 - 3) - 1, 0, 1)
    return value[:, None] * (1 - saturation[:, None] * (1 - wheel))


def weight_colors(weights: Array) -> Array:
    """(N, 3) sRGB of weights (N, B): the bones' colours, mixed by their weights."""
    return np.asarray(weights, np.float64) @ bone_colors(weights.shape[1])
