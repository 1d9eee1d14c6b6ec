# SPDX-License-Identifier: GPL-3.0-or-later
"""Zstandard streams, by whichever module of this Python knows them."""

from __future__ import annotations

import importlib
import io
from typing import IO, Any, BinaryIO

from ..errors import InputError

_MAX_WINDOW = 1 << 27
"""Bytes that a stream may ask the decoder to keep: the format's own default limit."""


def open_zstd(file: io.RawIOBase) -> IO[bytes]:
    """The unpacked bytes of one zstd frame, to be read in pieces; what is wrong shows as an error of `zstd_errors`.

    Raises InputError: this Python has no zstandard.
    """
    module = _module()
    if module.__name__ == "zstandard":  # ships with Blender 4.3 and later
        stream: IO[bytes] = module.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(file)
        return stream
    reader: IO[bytes] = module.ZstdFile(file)
    return reader


def compress_zstd(data: bytes, level: int = 12) -> bytes:
    """`data` as one zstd frame that tells its size. Raises InputError: this Python has no zstandard."""
    module = _module()
    if module.__name__ == "zstandard":
        packed: bytes = module.ZstdCompressor(level=level).compress(data)
        return packed
    packed = module.compress(data, level)
    return packed


def zstd_errors() -> tuple[type[Exception], ...]:
    """What reading a damaged stream raises."""
    return (_module().ZstdError, EOFError)


class Part(io.RawIOBase):
    """The next `size` bytes of a file as a file of their own."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(min(len(buffer), self._left))
        self._left -= len(data)
        buffer[: len(data)] = data
        return len(data)


def _module() -> Any:
    """zstandard, or compression.zstd of Python 3.14."""
    for name in ("zstandard", "compression.zstd"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise InputError(
        "This Python cannot unpack zstandard, which .spz of version 4 needs; use Blender 4.3 or later or install the "
        "Python package zstandard, or save the splats as .spz of version 3 (splat-transform --spz-version 3) or .ply."
    )
