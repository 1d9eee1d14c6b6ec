# SPDX-License-Identifier: GPL-3.0-or-later
"""WebP by Blender's own image reader, for the splat files that hold such images."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.splats.webp import Pixels, register_decoder, unregister_decoder

CLASSES = ()


def decode(data: bytes) -> Pixels:
    """The exact pixels (H, W, 4) of a WebP file, the top row first; ValueError where Blender cannot read it.

    Bytes are given as they are: no colour management, no multiplication by alpha.
    """
    with tempfile.TemporaryDirectory(prefix="gskin-") as folder:
        path = Path(folder) / "image.webp"
        path.write_bytes(data)
        try:
            image = bpy.data.images.load(str(path))
        except RuntimeError as error:
            raise ValueError("Blender cannot load the WebP image") from error
        try:
            settings: Any = image.colorspace_settings
            with contextlib.suppress(TypeError):  # a colour configuration of one's own may not have that name
                settings.name = "Non-Color"
            image.alpha_mode = "CHANNEL_PACKED"
            width, height = image.size
            if not width or image.channels != 4 or image.is_float:
                raise ValueError("Blender cannot decode the WebP image")
            values = np.empty(4 * width * height, np.float32)
            buffer: Any = image.pixels
            buffer.foreach_get(values)
        finally:
            bpy.data.images.remove(image)
    values *= 255.0
    rows: Pixels = np.rint(values, out=values).astype(np.uint8).reshape(height, width, 4)[::-1]
    return np.ascontiguousarray(rows)


def register() -> None:
    register_decoder(decode)


def unregister() -> None:
    unregister_decoder(decode)
