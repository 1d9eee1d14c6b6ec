# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours for pictures of weights: one per bone, or a scale from blue to red."""

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


def heat_colors(values: Array) -> Array:
    """(N, 3) sRGB of values (N,): blue at 0 over green to red at 1, as Blender's Weight Paint has it."""
    hue = 4.0 * (1.0 - np.clip(np.asarray(values, np.float64), 0.0, 1.0))
    return np.clip(np.abs((hue[:, None] + [0, 4, 2]) % 6 - 3) - 1, 0, 1)
