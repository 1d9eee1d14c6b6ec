# SPDX-License-Identifier: GPL-3.0-or-later
"""Read .sog files of version 2 (PlayCanvas): a zip or a folder of meta.json and lossless WebP images.

One pixel per splat in each image: centres in 16 bits of log(1 + |x|) over two images, quaternions as the smallest
three with the place of the largest in alpha, log scales and the constant harmonic by a codebook of 256 values, opacity
in alpha of the latter. Higher harmonics are a palette of up to 65,536 sets, with a codebook of its own.
"""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, first_line
from ..files import is_plain_name
from .cloud import FloatArray
from .loaded import (
    EXPANSION,
    FREE_BYTES,
    Reading,
    check_count,
    cut_off,
    damaged,
    empty_splats,
    finish,
    opened,
    pieces,
)
from .smallest_three import restore_largest
from .webp import Pixels, decode_webp, webp_size

MAGIC = b"PK\x03\x04"
META = "meta.json"
FILES = {"means": 2, "scales": 1, "quats": 1, "sh0": 1, "shN": 2}
"""Number of images of each entry of meta.json; shN may be missing."""
ROW = 64
"""Sets of harmonics in a row of the palette's image."""
FIRST_PLACE = 252
"""Alpha of a quaternion whose largest component is w; x, y, z follow."""

_MAX_META = 16 << 20


@dataclass(frozen=True)
class _Source:
    """Files by name, of a zip or of a folder; size: of them all, in bytes."""

    path: Path
    size: int
    read: Callable[[str], bytes]


def read_sog(path: Path, drop_invalid: bool) -> Reading:
    """Read a .sog file, or a folder of its parts (also by its meta.json), piece by piece, with its own axes.

    Raises InputError: no such file, another version, missing or damaged images, names outside the folder, too large
    for its size, invalid splats, no decoder of WebP.
    """
    if path.is_dir() or path.name.lower() == META:
        return (yield from _read(_folder(path), drop_invalid))
    with opened(path) as (file, size):
        try:
            archive = zipfile.ZipFile(file)
        except _ZIP_ERRORS as error:
            raise damaged(path, f"no whole zip: {first_line(error)}") from error
        with archive:
            return (yield from _read(_archive(archive, path, size), drop_invalid))


_ZIP_ERRORS = (zipfile.BadZipFile, NotImplementedError, RuntimeError, zlib.error, EOFError, ValueError)


def _archive(archive: zipfile.ZipFile, path: Path, size: int) -> _Source:
    def read(name: str) -> bytes:
        try:
            entry = archive.getinfo(name)
        except KeyError:
            raise _missing(path, name) from None
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise damaged(path, f"'{name}' is packed by a method that no .sog uses")
        if entry.file_size > _MAX_META + 4 * size:
            raise damaged(path, f"'{name}' unpacks to {entry.file_size:,} bytes")
        try:
            return archive.read(entry)
        except _ZIP_ERRORS as error:
            raise damaged(path, f"'{name}': {first_line(error)}") from error

    return _Source(path, size, read)


def _folder(path: Path) -> _Source:
    folder = path if path.is_dir() else path.parent

    def read(name: str) -> bytes:
        try:
            return (folder / name).read_bytes()
        except FileNotFoundError:
            raise _missing(path, name) from None
        except OSError as error:
            raise InputError(f"{folder / name} cannot be read ({error.strerror or error}); check the path.") from error

    try:
        size = sum(entry.stat().st_size for entry in folder.iterdir() if entry.suffix in (".webp", ".json"))
    except OSError as error:
        raise InputError(f"'{path}' cannot be read ({error.strerror or error}); check the path.") from error
    return _Source(path, size, read)


def _missing(path: Path, name: str) -> InputError:
    if name == META:
        return InputError(f"'{path}' has no {META}, so it is no .sog; choose another file.")
    return InputError(f"'{path}' lacks '{name}', which its {META} names; export it again, with all of its files.")


def _read(source: _Source, drop_invalid: bool) -> Reading:
    path = source.path
    meta = _read_meta(source)
    count = meta["count"]
    bands = _bands(path, meta)
    check_count(path, count, bands, source.size)
    names = {entry: _names(path, meta, entry) for entry in FILES if entry in meta}
    cloud = empty_splats(count, bands)
    valid = np.ones(count, bool)
    lows, highs = (_numbers(path, meta["means"], key, 3) for key in ("mins", "maxs"))
    scale_book = _codebook(path, meta["scales"])
    color_book = _codebook(path, meta["sh0"])

    low = _image(source, names["means"][0], count)
    yield 0.05
    high = _image(source, names["means"][1], count)
    yield 0.1
    for rows in pieces(count):
        fixed = low[rows, :3].astype(np.float64) + 256.0 * high[rows, :3]
        logs = lows + (highs - lows) * (fixed / 65535.0)
        with np.errstate(over="ignore"):
            cloud.means[rows] = np.copysign(np.expm1(np.abs(logs)), logs)
        valid[rows] &= np.isfinite(cloud.means[rows]).all(axis=1)
        yield 0.1 + 0.1 * rows.stop / count
    del low, high
    pixels = _image(source, names["scales"][0], count)
    yield 0.3
    for rows in pieces(count):
        with np.errstate(over="ignore"):
            cloud.scales[rows] = np.exp(scale_book[pixels[rows, :3]])
        valid[rows] &= np.isfinite(cloud.scales[rows]).all(axis=1)
        yield 0.3 + 0.1 * rows.stop / count
    pixels = _image(source, names["quats"][0], count)
    yield 0.5
    for rows in pieces(count):
        others = (pixels[rows, :3] / 127.5 - 1.0) * 0.5**0.5
        valid[rows] &= pixels[rows, 3] >= FIRST_PLACE
        cloud.quats[rows] = restore_largest(pixels[rows, 3] & 3, others)
        yield 0.5 + 0.1 * rows.stop / count
    pixels = _image(source, names["sh0"][0], count)
    yield 0.7
    for rows in pieces(count):
        cloud.sh[rows, 0] = color_book[pixels[rows, :3]]
        cloud.opacities[rows] = pixels[rows, 3] / np.float32(255)
        valid[rows] &= np.isfinite(cloud.sh[rows, 0]).all(axis=1)
        yield 0.7 + 0.1 * rows.stop / count
    del pixels
    if bands:
        palette = _palette(source, meta["shN"], names["shN"][0], bands)
        yield 0.8
        pixels = _image(source, names["shN"][1], count)
        yield 0.9
        for rows in pieces(count):
            label = pixels[rows, 0].astype(np.int64) + 256 * pixels[rows, 1].astype(np.int64)
            if label.max() >= len(palette):
                raise damaged(path, f"a splat has harmonics {label.max()} of {len(palette)}")
            cloud.sh[rows, 1:] = palette[label]
            valid[rows] &= np.isfinite(cloud.sh[rows]).reshape(len(label), -1).all(axis=1)
            yield 0.9 + 0.1 * rows.stop / count
    return (yield from finish(path, cloud, valid, drop_invalid))


def _read_meta(source: _Source) -> dict[str, Any]:
    """The checked outer shape of meta.json: version, count, and an object for each entry."""
    path, data = source.path, source.read(META)
    if len(data) > _MAX_META:
        raise damaged(path, f"its {META} has {len(data):,} bytes")
    try:
        meta = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise damaged(path, f"its {META} is no JSON: {first_line(error)}") from error
    if not isinstance(meta, dict):
        raise damaged(path, f"its {META} holds no object")
    if meta.get("version") != 2:
        found = "without a version (1)" if "version" not in meta else f"of version {meta['version']!r:.20}"
        raise InputError(
            f"'{path}' is a .sog {found}, and version 2 is read; save it again with SuperSplat or splat-transform."
        )
    count = meta.get("count")
    if type(count) is not int or count < 0:
        raise damaged(path, f"its {META} has no count of splats")
    for entry in FILES:
        if not isinstance(meta.get(entry), dict) and (entry != "shN" or meta.get(entry) is not None):
            raise damaged(path, f"its {META} has no '{entry}'")
    if meta.get("shN") is None:
        meta.pop("shN", None)
    return meta


def _bands(path: Path, meta: dict[str, Any]) -> int:
    if "shN" not in meta:
        return 0
    bands = meta["shN"].get("bands")
    if type(bands) is not int or not 1 <= bands <= 4:
        raise damaged(path, f"harmonics of degree {bands!r:.20}")
    return bands


def _names(path: Path, meta: dict[str, Any], entry: str) -> list[str]:
    names = meta[entry].get("files")
    if not isinstance(names, list) or len(names) != FILES[entry] or not all(isinstance(name, str) for name in names):
        raise damaged(path, f"its {META} names no {FILES[entry]} files for '{entry}'")
    for name in names:
        if not is_plain_name(name):
            raise damaged(path, f"its {META} names the file {name!r:.60}, which is not one beside it")
    return names


def _numbers(path: Path, table: dict[str, Any], key: str, count: int) -> NDArray[np.float64]:
    values = table.get(key)
    if not isinstance(values, list) or len(values) != count or not all(map(_is_number, values)):
        raise damaged(path, f"its {META} has no {count} numbers '{key}'")
    return np.array(values, np.float64)


def _codebook(path: Path, table: dict[str, Any]) -> FloatArray:
    values = table.get("codebook")
    if isinstance(values, list) and len(values) == 256 and values[0] is None and all(map(_is_number, values[1:])):
        # Written so by early programs; the value that PlayCanvas puts there.
        values = [values[1] + (values[1] - values[255]) / 255.0, *values[1:]]
    with np.errstate(over="ignore"):
        return _numbers(path, {"codebook": values}, "codebook", 256).astype(np.float32)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and abs(value) < 1e300


def _pixels(source: _Source, name: str) -> Pixels:
    """An image of the source, at most as large as its size allows."""
    data = source.read(name)
    try:
        width, height = webp_size(data)
        if 4 * width * height > FREE_BYTES + EXPANSION * source.size:
            raise ValueError(f"an image of {width} x {height} pixels in {len(data):,} bytes")
        return decode_webp(data)
    except ValueError as error:
        raise damaged(source.path, f"'{name}': {first_line(error)}") from error


def _image(source: _Source, name: str, count: int) -> Pixels:
    """The pixels (M, 4) of an image with one for each splat; M >= count."""
    pixels = _pixels(source, name).reshape(-1, 4)
    if len(pixels) < count:
        raise cut_off(source.path, f"'{name}' has {len(pixels)} pixels for {count} splats")
    return pixels


def _palette(source: _Source, table: dict[str, Any], name: str, bands: int) -> FloatArray:
    """The sets of higher harmonics (P, K - 1, 3)."""
    book = _codebook(source.path, table)
    count, each = table.get("count"), (bands + 1) ** 2 - 1
    pixels = _pixels(source, name)
    if pixels.shape[1] != ROW * each or type(count) is not int or not 0 < count <= ROW * pixels.shape[0]:
        raise damaged(
            source.path, f"'{name}' of {pixels.shape[1]} x {pixels.shape[0]} pixels for {count!r:.20} sets of harmonics"
        )
    return book[pixels.reshape(-1, each, 4)[:count, :, :3]]
