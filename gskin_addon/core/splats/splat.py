# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write .splat files (antimatter15): 32 bytes per splat, no header, no view-dependent colour.

Three float32 for the centre, three for the linear scale, four bytes RGBA, four bytes for the quaternion wxyz as
128 + 128 q. Nothing marks such a file but its name and that 32 divides its size.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import write_atomically
from .cloud import SH_C0, Floats, SplatCloud
from .loaded import Reading, cut_off, empty_splats, finish, finite_rows, opened, pieces
from .ply_codec import decode_quats

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def read_splat(path: Path, drop_invalid: bool) -> Reading:
    """Read a .splat file piece by piece, with its own axes.

    Raises InputError: not a whole number of splats, none, negative scales (no .splat file), invalid splats.
    """
    with opened(path) as (file, size):
        count, rest = divmod(size, _ROW.itemsize)
        if rest:
            raise cut_off(path, f"{size} bytes are no whole number of splats of {_ROW.itemsize}")
        if count == 0:
            raise InputError(f"'{path}' has no splats; export it again.")
        cloud = empty_splats(count, 0)
        valid = np.empty(count, bool)
        for rows in pieces(count):
            table = np.fromfile(file, _ROW, rows.stop - rows.start)
            if len(table) < rows.stop - rows.start:
                raise cut_off(path, "it became shorter while it was read")
            if (table["scales"] < 0.0).any():
                raise InputError(f"'{path}' is no .splat file (negative scales); choose another file.")
            cloud.means[rows] = table["means"]
            cloud.scales[rows] = table["scales"]
            cloud.opacities[rows] = table["rgba"][:, 3] / np.float32(255)
            cloud.sh[rows, 0] = colors_to_sh(table["rgba"][:, :3])
            cloud.quats[rows] = decode_quats(table["quats"].astype(np.float64) - 128.0)
            valid[rows] = finite_rows(cloud, rows)
            yield rows.stop / count
    return (yield from finish(path, cloud, valid, drop_invalid))


def write_splat(path: Path, cloud: SplatCloud) -> None:
    """Write a .splat file; view-dependent colour is lost, colours and opacities become bytes."""

    def write(file: BinaryIO) -> None:
        for rows in pieces(cloud.count):
            table = np.empty(rows.stop - rows.start, _ROW)
            table["means"], table["scales"] = cloud.means[rows], cloud.scales[rows]
            table["rgba"][:, :3] = to_bytes(cloud.select(rows).base_colors(), 255.0)
            table["rgba"][:, 3] = to_bytes(cloud.opacities[rows], 255.0)
            table["quats"] = to_bytes(cloud.quats[rows], 128.0, 128.0)
            file.write(table.tobytes())

    write_atomically(path, write)


def colors_to_sh(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The constant harmonic (M, 3) of colours in bytes."""
    return ((rgb.astype(np.float64) / 255.0 - 0.5) / SH_C0).astype(np.float32)


def to_bytes(values: Floats, factor: float, offset: float = 0.0) -> NDArray[np.uint8]:
    """offset + factor * values, rounded and held within 0..255."""
    return np.clip(np.rint(values.astype(np.float64) * factor + offset), 0, 255).astype(np.uint8)
