# SPDX-License-Identifier: GPL-3.0-or-later
"""OpenEXR files of one part, in scan lines: what pictures with depth need, written without Blender.

After the file layout of the OpenEXR documentation (version 2, ZIP compression of 16 lines).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files import write_atomically

_LINES = 16
_NONE, _ZIP = 0, 3
_HALF, _FLOAT = 1, 2


def write_exr(
    path: Path, channels: Mapping[str, NDArray[Any]], *, compress: bool = True, pixel_aspect: float = 1.0
) -> None:
    """Channels (H, W) by name, float16 or float32, as an .exr; R, G, B are linear and multiplied by A.

    Raises:
        GSkinError: the disk is full or the folder cannot be written; `path` is then as it was before.
    """
    names = sorted(channels)  # the order that the format asks for
    shapes = {channels[name].shape for name in names}
    kinds = {channels[name].dtype for name in names}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or not kinds <= {np.dtype("f2"), np.dtype("f4")}:
        raise ValueError(f"channels have shapes {shapes} and types {kinds}; expected one (H, W), float16 or float32")
    height, width = next(iter(shapes))
    planes = [channels[name] for name in names]
    lines = _LINES if compress else 1
    blocks = []
    for first in range(0, height, lines):
        rows = range(first, min(first + lines, height))
        raw = b"".join(plane[row].astype(plane.dtype.newbyteorder("<")).tobytes() for row in rows for plane in planes)
        packed = _pack(raw) if compress else raw
        data = packed if len(packed) < len(raw) else raw
        blocks.append(struct.pack("<ii", first, len(data)) + data)
    head = _header(names, planes, width, height, compress, pixel_aspect)
    places = np.cumsum([len(head) + 8 * len(blocks)] + [len(block) for block in blocks[:-1]])
    write_atomically(path, lambda file: file.write(head + places.astype("<u8").tobytes() + b"".join(blocks)))


def _header(
    names: list[str], planes: list[NDArray[Any]], width: int, height: int, compress: bool, aspect: float
) -> bytes:
    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<iBxxxii", _HALF if plane.itemsize == 2 else _FLOAT, 0, 1, 1)
        for name, plane in zip(names, planes, strict=True)
    )
    attributes = [
        ("channels", "chlist", listed + b"\0"),
        ("compression", "compression", bytes([_ZIP if compress else _NONE])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", aspect)),
        ("screenWindowCenter", "v2f", struct.pack("<ff", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ]
    body = b"".join(
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
        for name, kind, value in attributes
    )
    return struct.pack("<ii", 20000630, 2) + body + b"\0"


def _pack(raw: bytes) -> bytes:
    """Even bytes, then odd ones, as differences, by zlib: the format's ZIP."""
    values = np.frombuffer(raw, np.uint8)
    apart = np.concatenate([values[0::2], values[1::2]])
    differences = apart.copy()
    differences[1:] = apart[1:] - apart[:-1] + np.uint8(128)
    return zlib.compress(differences.tobytes(), 4)
