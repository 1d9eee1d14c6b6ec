# SPDX-License-Identifier: GPL-3.0-or-later
"""Write lossless WebP images with numpy alone (RFC 9649): no back references, one prefix code per channel.

Such files are somewhat larger than those of libwebp and hold exactly the pixels that were given, also where alpha is 0.
"""

from __future__ import annotations

import heapq
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_SIDE = 1 << 14
"""Pixels that a WebP image may be wide or high."""

_LITERALS, _LENGTHS = 256, 24
"""Symbols of a channel; green has further ones, for repetitions."""
_LONGEST = 15
"""Bits of the longest code."""
# A code for the lengths of codes: 4 bits for each of 0..15, none for 17, 18 and 16 (repetitions); in the file's order.
_LENGTH_CODE = (0, 0, 4, 4, 4, 4, 4, 4, 0, *([4] * 10))

Bits = tuple[NDArray[np.uint64], NDArray[np.int64]]
"""Values and their numbers of bits, at most 64, to be written one after the other, the lowest bit first."""


def encode_webp(pixels: NDArray[np.uint8]) -> bytes:
    """A lossless WebP file of RGBA pixels (H, W, 4), the top row first. ValueError for an image too large or empty."""
    height, width = pixels.shape[:2]
    if pixels.ndim != 3 or pixels.shape[2] != 4 or not 0 < width <= MAX_SIDE or not 0 < height <= MAX_SIDE:
        raise ValueError(f"a WebP image cannot have the shape {pixels.shape}")
    head = [(0x2F, 8), (width - 1, 14), (height - 1, 14), (int((pixels[..., 3] < 255).any()), 1), (0, 3)]
    residuals = _left_residuals(pixels)
    if _entropy(residuals) < _entropy(pixels):
        # The predictor transform in blocks as large as can be, all of mode 1: the pixel to the left. The image of the
        # modes has one symbol per channel (green: the mode), which takes no bits.
        head += [(1, 1), (0, 2), (7, 3), (0, 1)]
        for symbol in (1, 0, 0, 255, 0):
            head += _single_symbol(symbol)
        pixels = residuals
    head += [(0, 1), (0, 1), (0, 1)]  # no (further) transform, no colour cache, one group of codes
    green, red, blue, alpha = (pixels[..., channel].reshape(-1) for channel in (1, 0, 2, 3))
    values = np.zeros(len(green), np.uint64)
    counts = np.zeros(len(green), np.int64)
    for channel, extra in ((green, _LENGTHS), (red, 0), (blue, 0), (alpha, 0)):
        lengths = _code_lengths(np.bincount(channel, minlength=_LITERALS + extra))
        if not lengths.any():
            head += _single_symbol(int(channel[0]))
            continue
        head += _describe(lengths)
        values |= _codes(lengths)[channel] << counts.astype(np.uint64)
        counts += lengths[channel]
    head += _single_symbol(0)  # distances: none are written
    start = (np.array([value for value, _ in head], np.uint64), np.array([bits for _, bits in head]))
    body = _pack(np.concatenate([start[0], values]), np.concatenate([start[1], counts]))
    body += bytes(len(body) % 2)
    return struct.pack("<4sI4s4sI", b"RIFF", len(body) + 12, b"WEBP", b"VP8L", len(body)) + body


def _left_residuals(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Differences to the pixel on the left; on the left edge to the one above, in the corner to opaque black."""
    residuals = pixels.copy()
    residuals[:, 1:] -= pixels[:, :-1]
    residuals[1:, 0] -= pixels[:-1, 0]
    residuals[0, :1, 3] -= np.uint8(255)
    return residuals


def _entropy(pixels: NDArray[np.uint8]) -> float:
    """Bits that the four channels take with ideal codes."""
    total = 0.0
    for channel in range(4):
        counts = np.bincount(pixels[..., channel].reshape(-1))
        counts = counts[counts > 0]
        total += float((counts * np.log2(counts.sum() / counts)).sum())
    return total


def _single_symbol(symbol: int) -> list[tuple[int, int]]:
    """A simple prefix code of one symbol in 8 bits."""
    return [(1, 1), (0, 1), (1, 1), (symbol, 8)]


def _code_lengths(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Lengths of a Huffman code of at most 15 bits; all 0 where there is one symbol only."""
    lengths = np.zeros(len(counts), np.int64)
    weights = counts.copy()
    while True:
        heap: list[tuple[int, int, tuple[int, ...]]] = [
            (int(weights[symbol]), int(symbol), (int(symbol),)) for symbol in np.flatnonzero(weights)
        ]
        heapq.heapify(heap)
        lengths[:] = 0
        while len(heap) > 1:
            first, second = heapq.heappop(heap), heapq.heappop(heap)
            below = first[2] + second[2]
            lengths[list(below)] += 1
            heapq.heappush(heap, (first[0] + second[0], min(first[1], second[1]), below))
        if lengths.max() <= _LONGEST:
            return lengths
        weights = np.where(weights > 0, (weights + 1) // 2, 0)  # flatter, and so shorter at the end


def _describe(lengths: NDArray[np.int64]) -> list[tuple[int, int]]:
    """The bits that tell a decoder the lengths."""
    told = [(0, 1), (len(_LENGTH_CODE) - 4, 4), *((length, 3) for length in _LENGTH_CODE), (0, 1)]
    return told + [(_reversed(int(length), 4), 4) for length in lengths]


def _codes(lengths: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Canonical codes of the lengths, their highest bit first in the file."""
    codes = np.zeros(len(lengths), np.uint64)
    code = 0
    for length in range(1, int(lengths.max()) + 1):
        for symbol in np.flatnonzero(lengths == length):
            codes[symbol] = _reversed(code, length)
            code += 1
        code <<= 1
    return codes


def _reversed(value: int, bits: int) -> int:
    return int(f"{value:0{bits}b}"[::-1], 2)


def _pack(values: NDArray[np.uint64], counts: NDArray[Any]) -> bytes:
    """Values of 0 to 64 bits, one after the other, the lowest bit first."""
    ends = np.cumsum(counts)
    starts = ends - counts
    place, shift = starts >> 6, (starts & 63).astype(np.uint64)
    words = np.zeros(int(ends[-1] >> 6) + 2, np.uint64)
    first = np.flatnonzero(np.diff(place, prepend=-1))
    words[place[first]] = np.bitwise_or.reduceat(values << shift, first)
    over = np.flatnonzero((starts & 63) + counts > 64)  # at most one value of each word goes on in the next
    words[place[over] + 1] |= values[over] >> (np.uint64(64) - shift[over])
    return words.astype("<u8").tobytes()[: (int(ends[-1]) + 7) // 8]
