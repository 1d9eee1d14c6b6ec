# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads safetensors files in numpy alone: a header in JSON, then raw numbers.

The layout: https://github.com/huggingface/safetensors#format.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "U8": "<u1"}
_LONGEST_HEADER = 100_000_000  # bytes, as the format has it


def read_safetensors(path: Path, *, tensors: bool = True) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
    """The metadata of a file and, if wanted, its tensors by name.

    Raises:
        OSError: it cannot be read. ValueError: it is no such file, is cut off, contradicts itself, or has numbers of a
        type that is not known here.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or length > min(size - 8, _LONGEST_HEADER):
            raise ValueError("the header is longer than the file")
        header = json.loads(file.read(length))
        if not isinstance(header, dict):
            raise ValueError("the header is no table")
        metadata = header.pop("__metadata__", {})
        if not isinstance(metadata, dict) or not all(isinstance(value, str) for value in metadata.values()):
            raise ValueError("the metadata is no table of words")
        if not tensors:
            return metadata, {}
        data = file.read()
    return metadata, {name: _tensor(name, entry, data) for name, entry in header.items()}


def _tensor(name: str, entry: Any, data: bytes) -> NDArray[Any]:
    if not isinstance(entry, dict) or str(entry.get("dtype")) not in _TYPES:
        raise ValueError(f"'{name}' has no known type")
    dtype = np.dtype(_TYPES[str(entry["dtype"])])
    shape: list[int] = _counts(name, entry.get("shape"))
    begin, end = _counts(name, entry.get("data_offsets"))
    if not begin <= end <= len(data) or end - begin != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"'{name}' does not lie in the file as its shape says")
    return np.frombuffer(data[begin:end], dtype).reshape(shape)


def _counts(name: str, values: Any) -> list[int]:
    if not isinstance(values, list) or not all(type(value) is int and value >= 0 for value in values):
        raise ValueError(f"'{name}' has no shape or place")
    return values
