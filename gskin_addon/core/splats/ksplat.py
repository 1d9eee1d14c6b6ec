# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write .ksplat files (mkkellogg's GaussianSplats3D), compression levels 0, 1 and 2.

A header of 4096 bytes, a header of 1024 bytes per section, then for each section the sizes of its partly filled
buckets, the buckets' centres and the splats. Level 0 holds float32; 1 and 2 hold centres as 16-bit steps within a
bucket and float16, 2 the harmonics as bytes. Colours are bytes always. Harmonics go band by band, the channels of a
band one after the other.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import write_atomically
from .cloud import AnyArray, SplatCloud
from .loaded import Reading, cut_off, damaged, empty_splats, finish, finite_rows, opened, pieces, with_degree
from .ply_codec import decode_quats
from .splat import colors_to_sh, to_bytes

_HEADER, _SECTION = 4096, 1024
_MAX_SECTIONS = 1 << 16
MAX_WRITTEN_DEGREE = 2
"""What the viewer of this format draws."""


@dataclass(frozen=True)
class _Section:
    count: int
    degree: int
    first: int
    """Byte of its first splat in the file."""
    row: np.dtype[Any]
    centers: NDArray[np.float32]
    """(B, 3) of its buckets."""
    sizes: NDArray[np.int64]
    """(B,) splats of each bucket."""
    step: float
    range: int


def read_ksplat(path: Path, drop_invalid: bool) -> Reading:
    """Read a .ksplat file piece by piece, with its own axes. Sections of a lower degree get harmonics of 0.

    Raises InputError: another version, damaged, cut off, no splats, invalid splats.
    """
    with opened(path) as (file, size):
        head = file.read(_HEADER)
        if len(head) < _HEADER:
            raise cut_off(path, "within its header")
        major, minor, allowed, _, _, announced, level = struct.unpack_from("<BB2xIIIIH", head, 0)
        if major != 0 or minor < 1 or level > 2:
            raise InputError(
                f"'{path}' is no .ksplat file of version 0.1 and level 0 to 2 (says {major}.{minor}, level {level}); "
                "choose another file, or turn it into a .ply."
            )
        if allowed > _MAX_SECTIONS or _HEADER + allowed * _SECTION > size:
            raise cut_off(path, f"{allowed:,} sections do not fit into {size:,} bytes")
        low, high = struct.unpack_from("<ff", head, 36)
        sections = list(_sections(file, path, size, allowed, level))
        count = sum(section.count for section in sections)
        if count != announced:
            raise damaged(path, f"its header announces {announced:,} splats, its sections {count:,}")
        if count == 0:
            raise InputError(f"'{path}' has no splats; export it again.")
        degree = max(section.degree for section in sections)
        cloud = empty_splats(count, degree)
        valid = np.empty(count, bool)
        done = 0
        for section in sections:
            file.seek(section.first)
            bucket = np.repeat(np.arange(len(section.sizes)), section.sizes)
            for rows in pieces(section.count):
                table = np.fromfile(file, section.row, rows.stop - rows.start)
                if len(table) < rows.stop - rows.start:
                    raise cut_off(path, "it became shorter while it was read")
                there = slice(done + rows.start, done + rows.stop)
                _decode(table, bucket[rows], section, (low or -1.5, high or 1.5), cloud, there)
                valid[there] = finite_rows(cloud, there) & (cloud.scales[there] >= 0.0).all(axis=1)
                yield there.stop / count
            done += section.count
    return (yield from finish(path, cloud, valid, drop_invalid))


def _row(level: int, degree: int) -> np.dtype[Any]:
    """One splat in the file."""
    number = "<f4" if level == 0 else "<f2"
    fields: list[Any] = [("means", "<f4" if level == 0 else "<u2", 3), ("scales", number, 3), ("quats", number, 4)]
    fields.append(("rgba", "u1", 4))
    if degree:
        fields.append(("sh", ("<f4", "<f2", "u1")[level], 3 * ((degree + 1) ** 2 - 1)))
    return np.dtype(fields)


def _sections(file: BinaryIO, path: Path, size: int, allowed: int, level: int) -> Iterator[_Section]:
    """The sections that hold splats."""
    headers = file.read(allowed * _SECTION)
    place = _HEADER + allowed * _SECTION
    for number in range(allowed):
        count, room, bucket, buckets, block, storage, steps, _, full, partial, degree = struct.unpack_from(
            "<IIIIfH2xIIIIH", headers, number * _SECTION
        )
        if count > room or degree > 3 or partial > buckets or (buckets and storage < 12):
            raise damaged(path, f"section {number} has {count:,} of {room:,} splats of degree {degree}")
        row = _row(level, degree)
        first = place + 4 * partial + storage * buckets
        end = first + room * row.itemsize
        if end > size:
            raise cut_off(path, f"section {number} ends at byte {end:,} of {size:,}")
        centers, sizes = np.zeros((0, 3), np.float32), np.zeros(0, np.int64)
        if level and count:
            file.seek(place)
            partly = np.fromfile(file, "<u4", partial)
            table = np.fromfile(file, np.uint8, storage * buckets).reshape(buckets, storage)
            centers = np.ascontiguousarray(table[:, :12]).view("<f4")
            sizes = np.full(buckets, bucket, np.int64)
            sizes[full:][: len(partly)] = partly[: max(0, buckets - full)]
            sizes = np.diff(np.minimum(np.cumsum(sizes), count), prepend=0)
            if sizes.sum() < count:
                raise damaged(path, f"section {number} has buckets for {sizes.sum():,} of {count:,} splats")
        steps = steps or (1 if level == 0 else 32767)
        if count:
            yield _Section(count, degree, first, row, centers, sizes, block / 2.0 / steps, steps)
        place = end


def _decode(
    table: AnyArray,
    bucket: NDArray[np.int64],
    section: _Section,
    sh_range: tuple[float, float],
    cloud: SplatCloud,
    rows: slice,
) -> None:
    """Fill `rows` of the cloud from rows of the file."""
    with np.errstate(over="ignore", invalid="ignore"):
        if table.dtype["means"].base == np.uint16:
            steps = table["means"].astype(np.float64) - section.range
            cloud.means[rows] = steps * section.step + section.centers[bucket]
        else:
            cloud.means[rows] = table["means"]
    cloud.scales[rows] = table["scales"]
    cloud.quats[rows] = decode_quats(table["quats"])
    cloud.opacities[rows] = table["rgba"][:, 3] / np.float32(255)
    cloud.sh[rows, 0] = colors_to_sh(table["rgba"][:, :3])
    cloud.sh[rows, 1:] = 0.0
    if section.degree:
        values = table["sh"].astype(np.float32)
        if table.dtype["sh"].base == np.uint8:
            values = sh_range[0] + values * np.float32((sh_range[1] - sh_range[0]) / 255.0)
        for band in range(1, section.degree + 1):
            first, last = band * band, (band + 1) ** 2
            part = values[:, 3 * (first - 1) : 3 * (last - 1)].reshape(len(table), 3, last - first)
            cloud.sh[rows, first:last] = part.transpose(0, 2, 1)


def write_ksplat(path: Path, cloud: SplatCloud) -> None:
    """Write a .ksplat file of level 0, float32; colours become bytes, harmonics above degree 2 are lost."""
    cloud = with_degree(cloud, MAX_WRITTEN_DEGREE)
    count, row = cloud.count, _row(0, cloud.sh_degree)
    center = cloud.means.mean(axis=0, dtype=np.float64)
    head = struct.pack("<BB2xIIIIH2xfffff", 0, 1, 1, 1, count, count, 0, *center.tolist(), -1.5, 1.5)
    section = struct.pack("<IIIIfH2xIIIIH", count, count, 0, 0, 0.0, 0, 0, count * row.itemsize, 0, 0, cloud.sh_degree)

    def write(file: BinaryIO) -> None:
        file.write(head.ljust(_HEADER, b"\0") + section.ljust(_SECTION, b"\0"))
        for rows in pieces(count):
            part = cloud.select(rows)
            table = np.empty(part.count, row)
            table["means"], table["scales"], table["quats"] = part.means, part.scales, part.quats
            table["rgba"][:, :3] = to_bytes(part.base_colors(), 255.0)
            table["rgba"][:, 3] = to_bytes(part.opacities, 255.0)
            for band in range(1, cloud.sh_degree + 1):
                first, last = band * band, (band + 1) ** 2
                values = part.sh[:, first:last].transpose(0, 2, 1).reshape(part.count, -1)
                table["sh"][:, 3 * (first - 1) : 3 * (last - 1)] = values
            file.write(table.tobytes())

    write_atomically(path, write)
