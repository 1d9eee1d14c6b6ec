# SPDX-License-Identifier: GPL-3.0-or-later
"""Read the compressed .ply of PlayCanvas and SuperSplat: 16 bytes per splat, value ranges per 256 splats.

`chunk` holds the ranges; `vertex` packs the position and the log scale as 11-10-11 bits, the quaternion as the
index of its largest component and three times 10 bits, colour and opacity as 8-8-8-8; `sh` holds one byte per
f_rest value.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .cloud import SH_C0, AnyArray, SplatCloud
from .ply_codec import REST_COUNTS, decode_scale, empty_cloud, rest_names
from .ply_header import Element, Header

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_RANGES = tuple(
    f"{end}_{axis}" for axis in ("x", "y", "z", "scale_x", "scale_y", "scale_z") for end in ("min", "max")
)
ROWS_PER_CHUNK = 256
_PIECE = 32 * ROWS_PER_CHUNK
SH_RANGE = 8.0
"""Harmonics are stored between -4 and 4."""

Values = NDArray[np.float64]


def is_compressed(header: Header) -> bool:
    """Whether the header announces the compressed layout."""
    vertex = header.element("vertex")
    return (
        vertex is not None and header.element("chunk") is not None and set(PACKED) <= set(vertex.properties)
    )


def read_compressed(
    file: BinaryIO, header: Header, path: Path
) -> Generator[float, None, tuple[SplatCloud, NDArray[np.bool_]]]:
    """All splats, and True (N,) where a splat is valid; InputError where the file is damaged."""
    if header.format != "binary_little_endian":
        raise InputError(
            f"'{path}' is a compressed .ply in {header.format}; export it again as binary little endian."
        )
    vertex, chunk, sh = header.element("vertex"), header.element("chunk"), header.element("sh")
    assert vertex is not None
    assert chunk is not None
    rest = 0 if sh is None else len(sh.properties)
    problem = _problem(vertex, chunk, sh, rest)
    if problem:
        raise InputError(f"'{path}' is a damaged compressed .ply ({problem}); export it again.")
    if vertex.count == 0:
        raise InputError(f"'{path}' has no splats; export it again.")
    tables = _map_elements(file, header, path)
    ranges = tables["chunk"]
    cloud = empty_cloud(vertex.count, rest)
    valid = np.empty(vertex.count, dtype=bool)
    for start in range(0, vertex.count, _PIECE):
        rows = slice(start, min(start + _PIECE, vertex.count))
        block = np.arange(rows.start, rows.stop) // ROWS_PER_CHUNK
        valid[rows] = _decode(tables["vertex"][rows], ranges[block], cloud, rows)
        if sh is not None:
            _decode_sh(tables["sh"][rows], cloud, rows, rest)
        yield rows.stop / vertex.count
    return cloud, valid


def _problem(vertex: Element, chunk: Element, sh: Element | None, rest: int) -> str | None:
    """What is wrong with the elements, None where nothing is."""
    missing = [name for name in _RANGES if name not in chunk.properties]
    if missing:
        return f"its chunks lack {', '.join(missing)}"
    if any(vertex.properties[name] != "u4" for name in PACKED):
        return "its packed values are not unsigned 32-bit integers"
    if chunk.count * ROWS_PER_CHUNK < vertex.count:
        return f"{chunk.count} chunks for {vertex.count} splats"
    if sh is not None:
        whole = set(sh.properties) == set(rest_names(rest)) and rest in REST_COUNTS
        if not whole or sh.count != vertex.count or set(sh.properties.values()) > {"u1"}:
            return "its harmonics are not one byte per f_rest value and splat"
    return None


def _map_elements(file: BinaryIO, header: Header, path: Path) -> dict[str, AnyArray]:
    """The rows of every element, memory-mapped; InputError where the file ends early."""
    size = os.fstat(file.fileno()).st_size
    offset = header.offset
    tables: dict[str, AnyArray] = {}
    for element in header.elements:
        if element.lists:
            raise InputError(f"'{path}' has list properties in '{element.name}'; export it without them.")
        dtype = element.dtype(header.order)
        found = max(0, size - offset) // max(dtype.itemsize, 1)
        if found < element.count:
            raise InputError(
                f"'{path}' is cut off: its header announces {element.count} rows of '{element.name}', "
                f"the file holds {found}; copy or export it again."
            )
        if element.count:
            tables[element.name] = np.memmap(
                file, dtype=dtype, mode="r", offset=offset, shape=(element.count,)
            )
        offset += element.count * dtype.itemsize
    return tables


def _unorm(word: NDArray[Any], shift: int, bits: int) -> Values:
    """Bits of a word as numbers from 0 to 1."""
    largest = (1 << bits) - 1
    return ((word >> shift) & largest).astype(np.float64) / largest


def _decode(packed: AnyArray, ranges: AnyArray, cloud: SplatCloud, rows: slice) -> NDArray[np.bool_]:
    """Fill `rows` of the cloud from packed words and the ranges of each word's chunk."""

    def dequantise(name: str, values: Values) -> Values:
        low, high = (ranges[f"{end}_{name}"].astype(np.float64) for end in ("min", "max"))
        return low * (1.0 - values) + high * values

    position, scale, color = (packed[f"packed_{name}"] for name in ("position", "scale", "color"))
    with np.errstate(invalid="ignore", over="ignore"):
        for axis, (name, shift, bits) in enumerate((("x", 21, 11), ("y", 11, 10), ("z", 0, 11))):
            cloud.means[rows, axis] = dequantise(name, _unorm(position, shift, bits))
            cloud.scales[rows, axis] = decode_scale(dequantise(f"scale_{name}", _unorm(scale, shift, bits)))
        for channel, (name, shift) in enumerate((("r", 24), ("g", 16), ("b", 8))):
            value = _unorm(color, shift, 8)
            if f"min_{name}" in (ranges.dtype.names or ()):  # absent in the first version of the format
                value = dequantise(name, value)
            cloud.sh[rows, 0, channel] = (value - 0.5) / SH_C0
    cloud.opacities[rows] = _unorm(color, 0, 8)
    cloud.quats[rows] = _unpack_quats(packed["packed_rotation"])
    finite = [np.isfinite(values[rows]).all(axis=1) for values in (cloud.means, cloud.scales, cloud.sh[:, 0])]
    return np.logical_and.reduce(finite)


def _unpack_quats(word: AnyArray) -> Values:
    """Unit quaternions (M, 4) wxyz from the index of the largest component and the three others."""
    others = np.stack([(_unorm(word, shift, 10) - 0.5) * 2.0**0.5 for shift in (20, 10, 0)], axis=1)
    largest = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("ni,ni->n", others, others)))
    place = (word >> 30).astype(np.int64)[:, None]
    columns = np.arange(4)[None, :]
    source = np.clip(np.where(columns < place, columns, columns - 1), 0, 2)
    quats = np.where(columns == place, largest[:, None], np.take_along_axis(others, source, axis=1))
    unit: Values = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return unit


def _decode_sh(table: AnyArray, cloud: SplatCloud, rows: slice, rest: int) -> None:
    """Fill the higher harmonics of `rows`; bytes 0 and 255 are the range's ends, others the middle of a step."""
    bands = rest // 3
    for index, name in enumerate(rest_names(rest)):
        byte = table[name].astype(np.float64)
        value = np.where(byte == 0, 0.0, np.where(byte == 255, 1.0, (byte + 0.5) / 256.0))
        cloud.sh[rows, 1 + index % bands, index // bands] = (value - 0.5) * SH_RANGE
