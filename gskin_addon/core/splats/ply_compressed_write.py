# SPDX-License-Identifier: GPL-3.0-or-later
"""Write the compressed .ply of PlayCanvas and SuperSplat (`ply_compressed.py` says what is in it)."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..files import write_atomically
from .cloud import SH_C0, AnyArray, SplatCloud
from .loaded import pieces, with_degree
from .morton import morton_order
from .ply_codec import rest_names
from .ply_compressed import PACKED, ROWS_PER_CHUNK, SH_RANGE
from .ply_header import TYPE_NAMES
from .smallest_three import drop_largest

MAX_DEGREE = 3
_LOG_SCALES = (-20.0, 20.0)
"""Log scales are held within, so that one speck of size 0 does not cost its neighbours their precision."""
_CHUNK_NAMES = tuple(
    f"{end}_{axis}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for axis in names
)

Words = NDArray[np.uint32]
Values = NDArray[np.float64]


def write_compressed(path: Path, cloud: SplatCloud) -> None:
    """Write a compressed .ply of about 16 bytes per splat, and one per value of its higher harmonics.

    The splats are put along a Morton curve, so that the 256 of a chunk lie close together: positions keep a 2,000th of
    the chunk's size. Harmonics above degree 3 are lost, and others held within -4 to 4.
    """
    cloud = with_degree(cloud, MAX_DEGREE)
    order = morton_order(cloud.means)
    count, rest = cloud.count, 3 * (cloud.sh.shape[1] - 1)
    chunks = -(-count // ROWS_PER_CHUNK)
    ranges = np.empty((chunks, len(_CHUNK_NAMES)), "<f4")
    packed = np.empty((count, len(PACKED)), "<u4")
    for rows in pieces(count):
        part = cloud.select(order[rows])
        first = rows.start // ROWS_PER_CHUNK
        there = slice(first, first - (-part.count // ROWS_PER_CHUNK))
        packed[rows] = _pack(part, ranges[there])

    def write(file: BinaryIO) -> None:
        elements = [("chunk", chunks, "f4", _CHUNK_NAMES), ("vertex", count, "u4", PACKED)]
        if rest:
            elements.append(("sh", count, "u1", rest_names(rest)))
        lines = ["ply", "format binary_little_endian 1.0"]
        for name, rows_of_it, code, properties in elements:
            lines.append(f"element {name} {rows_of_it}")
            lines += [f"property {TYPE_NAMES[code]} {of_it}" for of_it in properties]
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))
        file.write(ranges.tobytes())
        file.write(packed.tobytes())
        for rows in pieces(count if rest else 0):
            values = cloud.sh[order[rows], 1:].transpose(0, 2, 1).reshape(-1, rest)  # channel by channel
            steps = np.floor((values / SH_RANGE + 0.5) * 256.0)
            file.write(np.clip(steps, 0, 255).astype(np.uint8).tobytes())

    write_atomically(path, write)


def _pack(part: SplatCloud, ranges: AnyArray) -> Words:
    """The packed words (M, 4) of splats that begin a chunk; fills the ranges of their chunks."""
    chunk = np.arange(part.count) // ROWS_PER_CHUNK
    with np.errstate(divide="ignore"):
        logs = np.clip(np.log(part.scales.astype(np.float64)), *_LOG_SCALES)
    colors = 0.5 + SH_C0 * part.sh[:, 0].astype(np.float64)
    steps = []
    for place, values in enumerate((part.means.astype(np.float64), logs, colors)):
        starts = np.arange(0, part.count, ROWS_PER_CHUNK)
        low = ranges[:, 6 * place : 6 * place + 3]
        high = ranges[:, 6 * place + 3 : 6 * place + 6]
        low[:] = np.minimum.reduceat(values, starts, axis=0)
        high[:] = np.maximum.reduceat(values, starts, axis=0)
        span = np.where(high > low, high.astype(np.float64) - low, 1.0)
        steps.append((values - low[chunk]) / span[chunk])
    largest, others = drop_largest(part.quats)
    fields = np.concatenate([largest[:, None] / 3.0, others * 0.5**0.5 + 0.5], axis=1)
    rgba = np.concatenate([steps[2], part.opacities[:, None]], axis=1)
    return np.stack(
        [
            _word(steps[0], (11, 10, 11)),
            _word(fields, (2, 10, 10, 10)),
            _word(steps[1], (11, 10, 11)),
            _word(rgba, (8, 8, 8, 8)),
        ],
        axis=1,
    )


def _word(values: Values, bits: tuple[int, ...]) -> Words:
    """Numbers (M, k) from 0 to 1 in fields of so many bits, the first one highest."""
    word = np.zeros(len(values), np.uint32)
    for column, width in enumerate(bits):
        largest = (1 << width) - 1
        field = np.rint(np.clip(values[:, column], 0.0, 1.0) * largest).astype(np.uint32)
        word = (word << np.uint32(width)) | field
    return word
