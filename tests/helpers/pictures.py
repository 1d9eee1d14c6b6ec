# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures on disk, read by Blender itself: its Python has no imaging library."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np


def read_picture(path: Path) -> np.ndarray:
    """The colours (H, W, 3) of an 8-bit picture as stored, uint8, its upper row first; alpha is left out."""
    image = bpy.data.images.load(str(path))
    try:
        (width, height), channels = image.size, image.channels
        flat = np.empty(width * height * channels, np.float32)
        image.pixels.foreach_get(flat)
    finally:
        bpy.data.images.remove(image)
    pixels = flat.reshape(height, width, channels)[::-1, :, :3]
    return np.rint(255 * np.broadcast_to(pixels, (height, width, 3))).astype(np.uint8)
