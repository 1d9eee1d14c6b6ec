# SPDX-License-Identifier: GPL-3.0-or-later
"""Write .sog files of version 2 (`sog.py` says what is in them): a zip, or the folder of a meta.json."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..files import write_atomically
from .cloud import AnyArray, SplatCloud
from .codebooks import codebook, nearest_entry, palette
from .loaded import pieces, with_degree
from .smallest_three import drop_largest
from .sog import FIRST_PLACE, META, ROW
from .splat import to_bytes
from .webp_encode import encode_webp

MAX_DEGREE = 3
_PALETTE = 1 << 16
_SMALLEST = 1e-30
"""Scales below are written as this one: the codebook holds logarithms."""

Pixels = NDArray[np.uint8]


def write_sog(path: Path, cloud: SplatCloud) -> None:
    """Write a .sog; for a path that ends in meta.json, that file and its images beside it.

    The splats keep their order. Harmonics above degree 3 are lost; those of more than 65,536 splats become the
    nearest of a palette of so many.
    """
    cloud = with_degree(cloud, MAX_DEGREE)
    if path.name.lower() == META:
        for name, data in _parts(cloud):  # meta.json last: before, it names nothing that is not there
            _write_bytes(path.with_name(path.name if name == META else name), data)
        return

    def write(file: BinaryIO) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, data in _parts(cloud):
                archive.writestr(zipfile.ZipInfo(name), data)

    write_atomically(path, write)


def _write_bytes(path: Path, data: bytes) -> None:
    write_atomically(path, lambda file: file.write(data))


def _parts(cloud: SplatCloud) -> Iterator[tuple[str, bytes]]:
    """The files by name, one after the other, meta.json last."""
    count = cloud.count
    meta: dict[str, Any] = {"version": 2, "count": count}

    logs = np.copysign(np.log1p(np.abs(cloud.means, dtype=np.float64)), cloud.means)
    lows, highs = logs.min(axis=0), logs.max(axis=0)
    fixed = np.rint((logs - lows) / np.where(highs > lows, highs - lows, 1.0) * 65535.0).astype(np.uint16)
    yield "means_l.webp", _image(fixed & 255)
    yield "means_u.webp", _image(fixed >> 8)
    names = ["means_l.webp", "means_u.webp"]
    meta["means"] = {"mins": lows.tolist(), "maxs": highs.tolist(), "files": names}

    logs = np.log(np.maximum(cloud.scales, _SMALLEST))
    book = codebook(logs)
    yield "scales.webp", _image(nearest_entry(book, logs))
    meta["scales"] = {"codebook": book.tolist(), "files": ["scales.webp"]}

    quats = np.empty((count, 4), np.uint8)
    for rows in pieces(count):
        place, others = drop_largest(cloud.quats[rows])
        quats[rows, :3] = to_bytes(others, 127.5 * 2.0**0.5, 127.5)
        quats[rows, 3] = FIRST_PLACE + place
    yield "quats.webp", _image(quats)
    meta["quats"] = {"files": ["quats.webp"]}

    book = codebook(cloud.sh[:, 0])
    colors = np.concatenate(
        [nearest_entry(book, cloud.sh[:, 0]), to_bytes(cloud.opacities, 255.0)[:, None]], axis=1
    )
    yield "sh0.webp", _image(colors)
    meta["sh0"] = {"codebook": book.tolist(), "files": ["sh0.webp"]}

    if cloud.sh_degree:
        each = cloud.sh.shape[1] - 1
        entries, label = palette(np.ascontiguousarray(cloud.sh[:, 1:]).reshape(count, -1), _PALETTE)
        book = codebook(entries)
        table = np.zeros((math.ceil(len(entries) / ROW) * ROW, each, 3), np.uint8)
        table[: len(entries)] = nearest_entry(book, entries).reshape(-1, each, 3)
        yield "shN_centroids.webp", encode_webp(_opaque(table.reshape(-1, ROW * each, 3)))
        yield "shN_labels.webp", _image(np.stack([label & 255, label >> 8], axis=1))
        files = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {
            "count": len(entries),
            "bands": cloud.sh_degree,
            "codebook": book.tolist(),
            "files": files,
        }
    yield META, json.dumps(meta).encode()


def _image(values: AnyArray) -> bytes:
    """An image of values (N, 2), (N, 3) or (N, 4), one pixel each, nearly square, sides that four divides."""
    width = math.ceil(len(values) ** 0.5 / 4) * 4
    height = math.ceil(len(values) / width / 4) * 4
    table = np.zeros((height * width, values.shape[1]), np.uint8)
    table[: len(values)] = values
    return encode_webp(_opaque(table.reshape(height, width, -1)))


def _opaque(table: Pixels) -> Pixels:
    """Pixels (H, W, 4) of values (H, W, 2 to 4); alpha 255 where there is none."""
    pixels = np.zeros((*table.shape[:2], 4), np.uint8)
    pixels[..., 3] = 255
    pixels[..., : table.shape[2]] = table
    return pixels
