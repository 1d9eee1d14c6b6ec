# SPDX-License-Identifier: GPL-3.0-or-later
"""The JSON, the buffers and the accessors of .gltf and .glb files (glTF 2.0), with every index and length checked."""

from __future__ import annotations

import base64
import binascii
import json
import struct
import urllib.parse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, first_line
from ..files import is_plain_name
from .cloud import AnyArray
from .loaded import cut_off, damaged, opened

MAGIC = b"glTF"
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_MAX_JSON = 256 << 20

_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@dataclass(frozen=True)
class GltfFile:
    """A glTF file: its JSON object, its buffers' bytes, and its whole size with them."""

    path: Path
    json: Mapping[str, Any]
    buffers: tuple[NDArray[np.uint8], ...]
    size: int

    def items(self, name: str) -> list[dict[str, Any]]:
        """The top-level array `name` of objects; empty where there is none."""
        items = self.json.get(name, [])
        if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
            raise damaged(self.path, f"its {name} are no list of objects")
        return items

    def item(self, name: str, index: Any) -> dict[str, Any]:
        """One of the objects of the top-level array `name`."""
        items = self.items(name)
        if type(index) is not int or not 0 <= index < len(items):
            raise damaged(self.path, f"there is no entry {index!r:.20} in its {name}")
        return items[index]

    def view_bytes(self, index: Any) -> NDArray[np.uint8]:
        """The bytes of a buffer view."""
        view = self.item("bufferViews", index)
        compressed = next(iter(view.get("extensions") or ()), None)
        if compressed is not None:
            raise InputError(
                f"'{self.path}' is compressed by {compressed:.60}, which is not read; export it without, or as .ply."
            )
        start, length = self._whole(view, "byteOffset", 0), self._whole(view, "byteLength", None)
        place = self._whole(view, "buffer", None)
        if place >= len(self.buffers) or start + length > len(self.buffers[place]):
            raise damaged(self.path, f"buffer view {index} lies outside of its buffer")
        return self.buffers[place][start : start + length]

    def accessor(self, index: Any, *, whole: bool = False) -> AnyArray:
        """The values (N,) or (N, k) of an accessor: a view of its buffer, normalised integers as float32.

        whole: whole numbers are wanted, such as indices, and come as they are stored.

        Raises InputError: outside of its buffer, sparse, or of a kind that glTF does not have.
        """
        table = self.item("accessors", index)
        code, width = _TYPES.get(table.get("componentType", 0)), _WIDTHS.get(table.get("type", ""))
        if code is None or width is None:
            raise damaged(self.path, f"accessor {index} is of no type that splats have")
        if "sparse" in table or "bufferView" not in table:
            raise InputError(f"'{self.path}' has a sparse accessor, which is not read; export it again without.")
        dtype = np.dtype(code)
        count, offset = self._whole(table, "count", None), self._whole(table, "byteOffset", 0)
        data = self.view_bytes(table["bufferView"])
        stride = self._whole(self.item("bufferViews", table["bufferView"]), "byteStride", 0) or width * dtype.itemsize
        if stride < width * dtype.itemsize:
            raise damaged(self.path, f"accessor {index} has a stride of {stride} bytes")
        if count and offset + (count - 1) * stride + width * dtype.itemsize > len(data):
            raise damaged(self.path, f"accessor {index} of {count} values lies outside of its buffer")
        values: AnyArray = np.ndarray(
            (count, width), dtype, data.data, offset, (stride, dtype.itemsize)
        )
        if whole:
            if dtype.kind != "u":
                raise damaged(self.path, f"accessor {index} holds no whole numbers")
        elif dtype.kind != "f":
            if not table.get("normalized"):
                raise damaged(self.path, f"accessor {index} holds integers, where numbers of splats must be")
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1.0))
        return values[:, 0] if width == 1 else values

    def _whole(self, table: Mapping[str, Any], key: str, default: int | None) -> int:
        value = table.get(key, default)
        if type(value) is not int or value < 0:
            raise damaged(self.path, f"its {key} is {value!r:.20}")
        return value


def read_container(path: Path) -> GltfFile:
    """Read a .glb or .gltf file, with the buffers that it names.

    Raises InputError: damaged, cut off, another version of glTF, a buffer that is missing or lies elsewhere.
    """
    with opened(path) as (file, size):
        start = file.read(12)
        if start[:4] != MAGIC:
            file.seek(0)
            if size > _MAX_JSON:
                raise damaged(path, "no glTF in text is so long")
            return _with_buffers(path, _parse(path, file.read()), None, size)
        if len(start) < 12:
            raise cut_off(path, "within its header")
        version, length = struct.unpack_from("<II", start, 4)
        if version != 2:
            raise InputError(f"'{path}' is glTF of version {version}, and version 2 is read; export it again.")
        if length > size:
            raise cut_off(path, f"it announces {length:,} bytes and has {size:,}")
        text, binary = b"", None
        place = 12
        while place + 8 <= length:
            chunk, kind = struct.unpack("<II", file.read(8))
            place += 8 + chunk
            if place > length:
                raise cut_off(path, "within a chunk")
            if kind == _JSON and not text:
                if chunk > _MAX_JSON:
                    raise damaged(path, f"its JSON has {chunk:,} bytes")
                text = file.read(chunk)
            elif kind == _BIN and binary is None:
                binary = _mapped(file, place - chunk, chunk)
            file.seek(place)
        return _with_buffers(path, _parse(path, text), binary, size)


def _parse(path: Path, text: bytes) -> dict[str, Any]:
    try:
        parsed = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise damaged(path, f"no JSON: {first_line(error)}") from error
    asset = parsed.get("asset") if isinstance(parsed, dict) else None
    if not isinstance(asset, dict) or not str(asset.get("version", "")).startswith("2."):
        raise InputError(f"'{path}' is no glTF 2.0 file; choose another file.")
    found: dict[str, Any] = parsed
    return found


def _with_buffers(path: Path, parsed: dict[str, Any], binary: NDArray[np.uint8] | None, size: int) -> GltfFile:
    bare = GltfFile(path, parsed, (), size)
    buffers = []
    for place, buffer in enumerate(bare.items("buffers")):
        uri = buffer.get("uri")
        if uri is None and place == 0 and binary is not None:
            data = binary
        elif isinstance(uri, str) and uri.startswith("data:"):
            try:
                data = np.frombuffer(base64.b64decode(uri.partition(",")[2], validate=True), np.uint8)
            except (binascii.Error, ValueError) as error:
                raise damaged(path, f"its buffer {place} is no base64") from error
        elif isinstance(uri, str):
            data = _beside(path, urllib.parse.unquote(uri))
            size += len(data)
        else:
            raise damaged(path, f"its buffer {place} has no bytes")
        length = buffer.get("byteLength")
        if type(length) is not int or length > len(data):
            raise cut_off(path, f"its buffer {place} has {len(data):,} of {length!r:.20} bytes")
        buffers.append(data)
    return GltfFile(path, parsed, tuple(buffers), size)


def _beside(path: Path, name: str) -> NDArray[np.uint8]:
    """The bytes of a file in the folder of `path` or below it; no other path is followed."""
    parts = name.split("/")
    if not all(is_plain_name(part) for part in parts):
        raise damaged(path, f"it names the file {name!r:.60}, which is not one beside it")
    other = path.parent.joinpath(*parts)
    if not other.is_file():
        raise InputError(f"'{path}' lacks '{name}', which it names; copy it beside it, or export a .glb.")
    with opened(other) as (file, size):
        return _mapped(file, 0, size)


def _mapped(file: BinaryIO, start: int, length: int) -> NDArray[np.uint8]:
    """Bytes of a file that are read when they are asked for."""
    return np.memmap(file, np.uint8, "r", start, (length,)) if length else np.empty(0, np.uint8)
