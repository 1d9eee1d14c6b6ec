# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's image reader gives the very bytes of lossless WebP images."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from gskin_addon.core.splats.webp import decode_webp, register_decoder, unregister_decoder
from gskin_addon.core.splats.webp_encode import encode_webp
from gskin_addon.scene.webp_images import decode


def test_bytes_are_exact_whatever_alpha_is():
    """No colour management, no multiplication by alpha: every pair of a value and an alpha is there."""
    values, alphas = np.meshgrid(np.arange(256), np.arange(256))
    pixels = np.stack([values, 255 - values, values ^ 85, alphas], axis=-1).astype(np.uint8)
    images = len(bpy.data.images)
    np.testing.assert_array_equal(decode(encode_webp(pixels)), pixels)
    assert len(bpy.data.images) == images


def test_what_blender_cannot_read_is_an_error_and_leaves_no_image():
    images = len(bpy.data.images)
    data = encode_webp(np.random.default_rng(0).integers(0, 256, (20, 30, 4), dtype=np.uint8))
    with pytest.raises(ValueError, match="Blender cannot"):
        decode(b"nothing")
    register_decoder(decode)
    try:
        with pytest.raises(ValueError, match="cut off"):  # Blender 5.0 would give an image of other pixels
            decode_webp(data[:100])
    finally:
        unregister_decoder(decode)
    assert len(bpy.data.images) == images
