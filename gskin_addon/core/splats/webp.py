# SPDX-License-Identifier: GPL-3.0-or-later
"""Pixels of lossless WebP images, by a decoder of the program around us: Blender registers its own, else Pillow."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Pixels = NDArray[np.uint8]
"""(H, W, 4) RGBA, the top row first."""
Decoder = Callable[[bytes], Pixels]
"""The exact pixels of a WebP file; ValueError where it cannot be decoded."""

_registered: list[Decoder] = []


def register_decoder(decoder: Decoder) -> None:
    """Let `decode_webp` use this decoder; the last one registered counts."""
    if decoder not in _registered:
        _registered.append(decoder)


def unregister_decoder(decoder: Decoder) -> None:
    """Undo `register_decoder`."""
    if decoder in _registered:
        _registered.remove(decoder)


def webp_size(data: bytes) -> tuple[int, int]:
    """Width and height that a lossless WebP file announces. ValueError for anything else."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise ValueError("it is no WebP image")
    place = 12
    while place + 8 <= len(data):
        kind, length = data[place : place + 4], struct.unpack_from("<I", data, place + 4)[0]
        body = data[place + 8 : place + 13]
        if kind == b"VP8L":
            if len(body) < 5 or body[0] != 0x2F or place + 8 + length > len(data):
                raise ValueError("the WebP image is cut off")
            (bits,) = struct.unpack_from("<I", body, 1)
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        if kind in (b"VP8 ", b"ANIM", b"ANMF"):
            raise ValueError("the WebP image is lossy or animated, where exact values must be")
        place += 8 + length + (length & 1)
    raise ValueError("the WebP image is cut off")


def decode_webp(data: bytes) -> Pixels:
    """The pixels of a lossless WebP file.

    Raises ValueError: damaged. InputError: nothing here can decode WebP.
    """
    width, height = webp_size(data)
    pixels = (_registered[-1] if _registered else _pillow())(data)
    if pixels.shape != (height, width, 4) or pixels.dtype != np.uint8:
        raise ValueError(f"the WebP image has other than {width} x {height} pixels")
    return pixels


def _pillow() -> Decoder:
    try:
        from PIL import Image
    except ImportError:
        raise InputError(
            "Nothing here can decode the WebP images of .sog; import it in Blender, install the Python package Pillow, "
            "or turn it into a .ply (splat-transform does)."
        ) from None

    def decode(data: bytes) -> Pixels:
        try:
            with Image.open(io.BytesIO(data), formats=("WEBP",)) as image:
                return np.asarray(image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise ValueError(f"the WebP image cannot be decoded: {error}") from error

    return decode
