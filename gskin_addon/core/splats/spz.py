# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write .spz files (Niantic), versions 1 to 4.

Sections one after the other, each for all splats: centres (three 24-bit fixed-point numbers; float16 in version 1),
opacity, colour, log scale (a byte each), quaternion (three bytes; from version 3 the smallest three in 32 bits),
harmonics (a byte each, the channel fastest). Versions 1 to 3 are one gzip stream with a 16-byte header; version 4 is
a 32-byte header, a table of sizes, and one zstd stream per section. Axes are right, up, back: y points up.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import write_atomically
from .cloud import AnyArray, SplatCloud
from .loaded import Reading, check_count, cut_off, damaged, empty_splats, finish, opened, pieces
from .smallest_three import drop_largest, restore_largest
from .splat import to_bytes
from .zstd import Part, compress_zstd, open_zstd, zstd_errors

MAGIC = b"NGSP"
VERSIONS = (1, 2, 3, 4)
UP = "y"
"""By the format's own rules: right, up, back."""

_COLOR = 0.15
"""Colours are stored as 0.5 + _COLOR * (constant harmonic)."""
_MAGNITUDE = 511
_BUCKETS = (8, 16)
"""Steps of the stored harmonics, of degree 1 and of the others, in 1/128: the reference's 5 and 4 bits."""
_STEPS = 65_536
"""Positions are written with at least so many steps from the origin to the farthest splat."""

Unpack = Callable[[int], bytes]
"""At most so many of the next unpacked bytes of a stream; none at its end."""


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    degree: int
    fraction_bits: int
    streams: int = 0
    table: int = 0

    def sections(self) -> dict[str, int]:
        """Bytes per splat of each section, in file order."""
        rest = 3 * ((self.degree + 1) ** 2 - 1)
        position, rotation = 6 if self.version == 1 else 9, 4 if self.version >= 3 else 3
        sizes = {"means": position, "opacities": 1, "colors": 3, "scales": 3, "quats": rotation, "sh": rest}
        return {name: size for name, size in sizes.items() if size}


def read_spz(path: Path, drop_invalid: bool) -> Reading:
    """Read an .spz file piece by piece, with its own axes (y up).

    Raises InputError: no .spz file, an unknown version, damaged, cut off, too large for its size, invalid splats.
    """
    with opened(path) as (file, size):
        return (yield from read_spz_stream(file, size, path, drop_invalid))


def read_spz_stream(file: BinaryIO, size: int, path: Path, drop_invalid: bool) -> Reading:
    """`read_spz` from an open file that holds `size` bytes from where it is; `path` names it in errors."""
    start = file.tell()
    if file.read(4) == MAGIC:
        file.seek(start)
        header = _parse(file.read(32), path)
        sources = _zstd_sources(file, start, size, header, path)
        failures = zstd_errors() if header.version == 4 else ()
    else:
        file.seek(start)
        unpack: Unpack = gzip.GzipFile(fileobj=file).read
        header = _parse(_unpacked(unpack, 16, path, _GZIP_ERRORS), path)
        if header.version == 4:
            raise damaged(path, "version 4 within gzip")
        sources = ((name, unpack) for name in header.sections())
        failures = _GZIP_ERRORS
    check_count(path, header.count, header.degree, size)
    cloud = empty_splats(header.count, header.degree, UP)
    valid = np.ones(header.count, bool)
    parts = header.sections()
    total, done = sum(parts.values()) * header.count, 0
    for name, unpack in sources:
        width = parts[name]
        for rows in pieces(header.count):
            data = _unpacked(unpack, width * (rows.stop - rows.start), path, failures)
            table = np.frombuffer(data, np.uint8).reshape(-1, width)
            _DECODERS[name](table, cloud, rows, header)
            done += len(data)
            yield done / total
    if header.version < 4:
        try:
            unpack(1)  # at its end gzip compares a check sum
        except EOFError as error:
            raise cut_off(path, "within its last bytes") from error
        except failures as error:
            raise damaged(path, str(error)) from error
    if header.version == 1:
        valid = np.isfinite(cloud.means).all(axis=1)
    return (yield from finish(path, cloud, valid, drop_invalid))


_GZIP_ERRORS: tuple[type[Exception], ...] = (EOFError, zlib.error, gzip.BadGzipFile)


def _parse(data: bytes, path: Path) -> _Header:
    if data[:3] == b"ply":
        raise InputError(f"'{path}' is a gzipped .ply, not an .spz file; unpack it and import the .ply.")
    if len(data) < 16 or data[:4] != MAGIC:
        raise InputError(f"'{path}' is no .spz file (it starts with other bytes); choose another file.")
    version, count, degree, bits, _flags, streams = struct.unpack_from("<IIBBBB", data, 4)
    if version not in VERSIONS:
        raise InputError(
            f"'{path}' is an .spz file of version {version}, and 1 to 4 are read; save it as version 3 or 4 or as .ply "
            "(splat-transform does)."
        )
    if degree > 4 or bits > 30:
        raise damaged(path, f"harmonics of degree {degree}, {bits} bits after the point")
    if version < 4:
        return _Header(version, count, degree, bits)
    if len(data) < 32:
        raise cut_off(path, "within its header")
    (table,) = struct.unpack_from("<I", data, 16)
    return _Header(version, count, degree, bits, streams, table)


def _zstd_sources(
    file: BinaryIO, start: int, size: int, header: _Header, path: Path
) -> Iterator[tuple[str, Unpack]]:
    """The sections of a file of version 4 and their unpacked streams, opened one after the other."""
    if header.version != 4:
        raise damaged(path, f"version {header.version} without gzip")
    parts = header.sections()
    end = header.table + 16 * header.streams
    if header.streams != len(parts) or header.table < 32:
        raise damaged(path, f"{header.streams} streams for harmonics of degree {header.degree}")
    if end > size:
        raise cut_off(path, "within its table of streams")
    file.seek(start + header.table)
    lengths = np.frombuffer(file.read(16 * header.streams), "<u8").reshape(-1, 2).tolist()
    if end + sum(packed for packed, _ in lengths) > size:
        raise cut_off(path, "its table of streams announces more bytes than it has")
    for (name, width), (_, unpacked) in zip(parts.items(), lengths, strict=True):
        if unpacked != width * header.count:
            raise damaged(path, f"{unpacked} bytes of {name} for {header.count} splats")

    def streams() -> Iterator[tuple[str, Unpack]]:
        place = start + end
        for name, (packed, _) in zip(parts, lengths, strict=True):
            file.seek(place)
            place += packed
            yield name, open_zstd(Part(file, packed)).read

    return streams()


def _unpacked(unpack: Unpack, wanted: int, path: Path, errors: tuple[type[Exception], ...]) -> bytes:
    """The next `wanted` bytes of a compressed stream, not more; InputError where they are not there."""
    found = b""
    try:
        while len(found) < wanted:
            data = unpack(wanted - len(found))
            if not data:
                raise cut_off(path, "it ends before its last splat")
            found = found + data if found else data
    except EOFError as error:
        raise cut_off(path, "it ends before its last splat") from error
    except errors as error:
        raise damaged(path, f"it cannot be unpacked: {str(error) or type(error).__name__}") from error
    return found


def _read_means(table: AnyArray, cloud: SplatCloud, rows: slice, header: _Header) -> None:
    if header.version == 1:
        cloud.means[rows] = table.view("<f2")
        return
    words = np.zeros((len(table), 3, 4), np.uint8)
    words[:, :, 1:] = table.reshape(-1, 3, 3)
    fixed = words.view("<i4")[:, :, 0] >> 8
    cloud.means[rows] = fixed * 2.0**-header.fraction_bits


def _read_opacities(table: AnyArray, cloud: SplatCloud, rows: slice, header: _Header) -> None:
    cloud.opacities[rows] = table[:, 0] / np.float32(255)


def _read_colors(table: AnyArray, cloud: SplatCloud, rows: slice, header: _Header) -> None:
    cloud.sh[rows, 0] = (table / 255.0 - 0.5) / _COLOR


def _read_scales(table: AnyArray, cloud: SplatCloud, rows: slice, header: _Header) -> None:
    cloud.scales[rows] = np.exp(table / 16.0 - 10.0)


def _read_quats(table: AnyArray, cloud: SplatCloud, rows: slice, header: _Header) -> None:
    if header.version < 3:
        xyz = table / 127.5 - 1.0
        w = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("ni,ni->n", xyz, xyz)))
        quats = np.concatenate([w[:, None], xyz], axis=1)
        cloud.quats[rows] = quats / np.linalg.norm(quats, axis=1, keepdims=True)
        return
    word = table.view("<u4")[:, 0]
    parts = [(word >> shift) & 1023 for shift in (20, 10, 0)]
    signed = [np.where(part >> 9, -1.0, 1.0) * (part & _MAGNITUDE) for part in parts]
    others = np.stack(signed, axis=1) * (0.5**0.5 / _MAGNITUDE)
    cloud.quats[rows] = np.roll(restore_largest(word >> 30, others), 1, axis=1)  # xyzw in the file


def _read_sh(table: AnyArray, cloud: SplatCloud, rows: slice, header: _Header) -> None:
    values = (table.astype(np.float32) - 128.0) / 128.0
    cloud.sh[rows, 1:] = values.reshape(len(table), -1, 3)


_DECODERS: dict[str, Callable[[AnyArray, SplatCloud, slice, _Header], None]] = {
    "means": _read_means,
    "opacities": _read_opacities,
    "colors": _read_colors,
    "scales": _read_scales,
    "quats": _read_quats,
    "sh": _read_sh,
}


def write_spz(path: Path, cloud: SplatCloud, *, version: int = 3) -> None:
    """Write an .spz file of version 3 or 4 from a cloud in the format's axes (y up).

    Version 3 is what every reader knows; 4 needs zstandard. Raises InputError for another version, for splats too far
    out for its 24-bit coordinates, and where this Python has no zstandard.
    """
    if version not in (3, 4):
        raise InputError(f".spz of version {version} is not written; use 3 or 4.")
    header = _Header(version, cloud.count, cloud.sh_degree, _fraction_bits(path, cloud))
    head = MAGIC + struct.pack("<IIBBB", version, header.count, header.degree, header.fraction_bits, 0)

    def write_gzip(file: BinaryIO) -> None:
        with gzip.GzipFile(filename="", mode="wb", fileobj=file, compresslevel=6, mtime=0) as packed:
            packed.write(head + b"\0")
            for name in header.sections():
                for data in _encoded(name, cloud, header):
                    packed.write(data)

    def write_zstd(file: BinaryIO) -> None:
        parts = header.sections()
        sizes, table = [], 32
        file.write(head + struct.pack("<BI12x", len(parts), table))
        file.write(bytes(16 * len(parts)))
        for name in parts:
            data = b"".join(_encoded(name, cloud, header))
            packed = compress_zstd(data)
            file.write(packed)
            sizes += [len(packed), len(data)]
        file.seek(table)
        file.write(struct.pack(f"<{len(sizes)}Q", *sizes))

    write_atomically(path, write_gzip if version == 3 else write_zstd)


def _fraction_bits(path: Path, cloud: SplatCloud) -> int:
    """Bits after the point: 12 as the reference, more for small objects, fewer for wide ones."""
    farthest = float(np.abs(cloud.means).max(initial=0.0))
    room = math.floor(math.log2((2**23 - 1) / max(farthest, 2.0**-7)))
    if room < 0:
        raise InputError(f"'{path}': a splat is {farthest:.3g} m from the origin, too far for .spz; write a .ply.")
    wanted = math.ceil(math.log2(_STEPS / max(farthest, 2.0**-7)))
    return min(room, max(12, wanted))


def _encoded(name: str, cloud: SplatCloud, header: _Header) -> Iterator[bytes]:
    """The bytes of a section, piece by piece."""
    for rows in pieces(cloud.count):
        yield _ENCODERS[name](cloud.select(rows), header).tobytes()


def _write_means(part: SplatCloud, header: _Header) -> NDArray[np.uint8]:
    fixed = np.rint(part.means.astype(np.float64) * 2.0**header.fraction_bits).astype("<i4")
    return fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]


def _write_scales(part: SplatCloud, header: _Header) -> NDArray[np.uint8]:
    with np.errstate(divide="ignore"):
        return to_bytes(np.log(part.scales), 16.0, 160.0)


def _write_quats(part: SplatCloud, header: _Header) -> AnyArray:
    place, others = drop_largest(np.roll(part.quats, -1, axis=1))
    size = np.minimum(np.rint(np.abs(others) * (_MAGNITUDE * 2.0**0.5)), _MAGNITUDE).astype(np.uint32)
    fields = size | np.where(others < 0.0, np.uint32(512), np.uint32(0))
    word = (place.astype(np.uint32) << 30) | (fields[:, 0] << 20) | (fields[:, 1] << 10) | fields[:, 2]
    return word.astype("<u4")


def _write_sh(part: SplatCloud, header: _Header) -> NDArray[np.uint8]:
    bucket = np.full((part.sh.shape[1] - 1, 1), _BUCKETS[1])
    bucket[:3] = _BUCKETS[0]
    steps = np.rint(part.sh[:, 1:].astype(np.float64) * 128.0 / bucket) * bucket
    return np.clip(steps + 128.0, 0.0, 255.0).astype(np.uint8)


_ENCODERS: dict[str, Callable[[SplatCloud, _Header], AnyArray]] = {
    "means": _write_means,
    "opacities": lambda part, header: to_bytes(part.opacities, 255.0),
    "colors": lambda part, header: to_bytes(part.sh[:, 0], 255.0 * _COLOR, 127.5),
    "scales": _write_scales,
    "quats": _write_quats,
    "sh": _write_sh,
}
