# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that are there whole or not at all. Standard library and numpy only."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from .errors import GSkinError

FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""errno values that mean: no room left on the disk."""


def write_atomically(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Call `write(file)` on a temporary file beside `path`, then put it in place.

    Raises:
        GSkinError: the disk is full or the folder cannot be written; `path` is then as it was before.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise disk_error(error, path) from error
    except ValueError as error:  # what zipfile says when it cannot close an archive on a full disk
        cause = full_disk(error)
        if cause is None:
            raise
        raise disk_error(cause, path) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def full_disk(error: BaseException | None) -> OSError | None:
    """The OSError of a full disk that led to `error` (libraries wrap it in errors of their own), or None."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, OSError) and error.errno in FULL:
            return error
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return None


def disk_error(error: OSError, path: str | Path | None = None) -> GSkinError:
    """One sentence for a failed write: a full disk, or whatever the system says."""
    name = str(path or error.filename or "the job folder")
    if error.errno in FULL:
        return GSkinError(
            f"The disk is full: '{name}' could not be written; free some space and start again, "
            "the job goes on from its last checkpoint."
        )
    return GSkinError(
        f"'{name}' could not be written ({error.strerror or error}); check the folder's permissions."
    )


def write_text(path: Path, text: str) -> None:
    """`text` as UTF-8."""
    write_atomically(path, lambda file: file.write(text.encode()))


def write_json(path: Path, value: Any) -> None:
    """`value` as indented UTF-8 JSON; NaN is refused (ValueError)."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """`arrays` as an uncompressed .npz without pickled objects."""
    if any(array.dtype.hasobject for array in arrays.values()):
        raise ValueError("object arrays are not stored")
    write_atomically(path, lambda file: np.savez(file, **dict(arrays)))


def write_png(path: Path, image: NDArray[Any]) -> None:
    """An (H, W, 3 or 4) image, float in 0..1 (sRGB) or uint8, as PNG (RFC 2083, filter 0)."""
    if image.ndim != 3 or image.shape[2] not in (3, 4) or 0 in image.shape:
        raise ValueError(f"image has shape {image.shape}, expected (H, W, 3 or 4)")
    pixels = image if image.dtype == np.uint8 else np.rint(np.clip(image, 0.0, 1.0) * 255).astype(np.uint8)
    height, width, channels = pixels.shape
    rows = np.zeros((height, 1 + width * channels), np.uint8)  # the leading zero of each row: no filter
    rows[:, 1:] = pixels.reshape(height, -1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2 if channels == 3 else 6, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    write_atomically(path, lambda file: file.write(b"\x89PNG\r\n\x1a\n" + body))
