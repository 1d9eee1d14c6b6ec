# SPDX-License-Identifier: GPL-3.0-or-later
"""Our lossless WebP images, as Pillow (libwebp) reads them, and what is no such image."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats import webp
from gskin_addon.core.splats.webp import decode_webp, webp_size
from gskin_addon.core.splats.webp_encode import MAX_SIDE, encode_webp

Image = pytest.importorskip("PIL.Image")

KINDS = {
    "noise": lambda rng, shape: rng.integers(0, 256, shape),
    "opaque": lambda rng, shape: np.where(np.arange(4) == 3, 255, rng.integers(0, 256, shape)),
    "one value": lambda rng, shape: np.full(shape, 7),
    "smooth": lambda rng, shape: np.cumsum(np.rint(2 * rng.normal(size=shape)), axis=1),
    "steep": lambda rng, shape: rng.geometric(0.7, shape),
}


@settings(max_examples=40, deadline=None)
@given(
    kind=st.sampled_from(list(KINDS)), height=st.integers(1, 70), width=st.integers(1, 70), seed=st.integers(0, 10**6)
)
def test_every_pixel_comes_back(kind, height, width, seed):
    pixels = KINDS[kind](np.random.default_rng(seed), (height, width, 4)).astype(np.uint8)
    data = encode_webp(pixels)
    assert webp_size(data) == (width, height)
    np.testing.assert_array_equal(decode_webp(data), pixels)


def test_codes_longer_than_15_bits_are_shortened():
    """Counts that halve from symbol to symbol ask for codes of 30 bits."""
    pixels = np.zeros((1024, 1024, 4), np.uint8)
    counts = 2 ** np.arange(20)
    pixels[..., 0].reshape(-1)[: counts.sum()] = np.random.default_rng(0).permutation(np.repeat(np.arange(20), counts))
    np.testing.assert_array_equal(decode_webp(encode_webp(pixels)), pixels)


def test_about_as_small_as_libwebp():
    rng = np.random.default_rng(1)
    pixels = np.cumsum(np.rint(2 * rng.normal(size=(200, 300, 4))), axis=1).astype(np.uint8)
    theirs = io.BytesIO()
    Image.fromarray(pixels).save(theirs, "WEBP", lossless=True, exact=True)
    assert len(encode_webp(pixels)) < 1.05 * len(theirs.getvalue())


def test_images_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="shape"):
        encode_webp(np.zeros((1, MAX_SIDE + 1, 4), np.uint8))
    with pytest.raises(ValueError, match="shape"):
        encode_webp(np.zeros((0, 3, 4), np.uint8))


def test_what_is_no_whole_lossless_image_is_refused():
    pixels = np.random.default_rng(2).integers(0, 256, (20, 30, 4), dtype=np.uint8)
    data = encode_webp(pixels)
    lossy = io.BytesIO()
    Image.fromarray(pixels).save(lossy, "WEBP", quality=80)
    for wrong in (b"", b"\x89PNG", lossy.getvalue(), *(data[:end] for end in range(0, len(data), 37))):
        with pytest.raises(ValueError, match="WebP"):
            decode_webp(wrong)


def test_a_decoder_that_gives_other_pixels_is_not_believed(monkeypatch):
    monkeypatch.setattr(webp, "_registered", [lambda data: np.zeros((3, 3, 4), np.uint8)])
    with pytest.raises(ValueError, match="other than 30 x 20 pixels"):
        decode_webp(encode_webp(np.zeros((20, 30, 4), np.uint8)))


def test_without_any_decoder_a_sentence_says_what_helps(monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.setattr(webp, "_registered", [])
    with pytest.raises(InputError, match=r"import it in Blender, install .* Pillow, or turn it into a \.ply"):
        decode_webp(encode_webp(np.zeros((2, 3, 4), np.uint8)))
