# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that are there whole or not at all, and arrays that bring no code. Standard library and numpy only."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from .errors import GSkinError, first_line

FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""errno values that mean: no room left on the disk."""

_MARK = ".gskin-"
# A name that nobody can guess, made here and now, and never a link that somebody put there.
_FRESH = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
_AGAIN = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Call `write(file)` on a temporary file beside `path`, then put it in place.

    Raises:
        GSkinError: the disk is full or the folder cannot be written; `path` is then as it was before.
    """
    with _in_place_of(path, ".tmp") as (_, descriptor), os.fdopen(descriptor, "wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())


@contextlib.contextmanager
def replaced(path: Path, suffix: str = ".tmp") -> Iterator[Path]:
    """An empty temporary file beside `path`, for those who write to a path; put in place when the block ends well.

    suffix: what its name ends in, for writers that look at it. Yields an absolute path.

    Raises:
        GSkinError: the disk is full or the folder cannot be written; `path` is then as it was before.
    """
    with _in_place_of(path, suffix) as (temporary, descriptor):
        os.close(descriptor)
        yield temporary
        written = os.open(temporary, _AGAIN)
        try:
            os.fsync(written)
        finally:
            os.close(written)


def is_plain_name(name: str) -> bool:
    """Whether `name` is that of a file in a folder at hand, on every system: no path, no drive, nothing hidden."""
    return (
        name == name.strip()
        and not name.startswith(".")
        and name.isprintable()
        and not set(name) & set('/\\:*?"<>|')
        and 0 < len(name.encode(errors="replace")) <= 200
    )


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of writers that were killed; nobody else may be writing in `folder` meanwhile."""
    for path in folder.glob(f"{_MARK}*"):
        with contextlib.suppress(OSError):
            path.unlink()


@contextlib.contextmanager
def _in_place_of(path: Path, suffix: str) -> Iterator[tuple[Path, int]]:
    """A new file beside `path` and its descriptor, which the block closes; renamed to `path` or removed after it."""
    temporary = None
    try:
        temporary, descriptor = _create(path.absolute().parent, suffix)
        yield temporary, descriptor
        os.replace(temporary, path)
    except OSError as error:
        raise disk_error(error, path) from error
    except Exception as error:  # zipfile, torch and others wrap what the disk says in errors of their own
        cause = full_disk(error)
        if cause is None:
            raise
        raise disk_error(cause, path) from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)


def _create(folder: Path, suffix: str) -> tuple[Path, int]:
    """As tempfile.mkstemp, but with the permissions that any new file gets here."""
    while True:
        path = folder / f"{_MARK}{secrets.token_hex(8)}{suffix}"
        with contextlib.suppress(FileExistsError):
            return path, os.open(path, _FRESH, 0o666)


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
            f"The disk is full: '{name}' could not be written ({error.strerror or error}); free some space and start "
            "again, a job goes on from its last checkpoint."
        )
    return GSkinError(f"'{name}' cannot be written ({error.strerror or error}); check the folder and its permissions.")


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


def read_arrays(
    path: Path, names: Sequence[str] | None = None, optional: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Arrays of an .npz by name: `names` (all of them when left out), and those of `optional` that are there.

    Pickled objects are refused, so that no file can run code.

    Raises:
        FileNotFoundError: there is no such file. OSError: it cannot be read.
        ValueError: it is no .npz, is damaged, holds pickled objects, or lacks one of `names`; says so in a few words.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as found:
            known = list(found.files)
            wanted = known if names is None else [*names, *(name for name in optional if name in known)]
            missing = [name for name in wanted if name not in known]
            arrays = {} if missing else {name: np.asarray(found[name]) for name in wanted}
    except OSError:
        raise
    except Exception as error:  # numpy, zipfile and zlib have many
        raise ValueError(first_line(error)) from None
    if missing:
        raise ValueError(f"it lacks the array {', '.join(missing)}")
    return arrays


def write_png(path: Path, image: NDArray[Any], *, bits: int = 8, level: int = 6) -> None:
    """An (H, W, 3 or 4) image, float in 0..1 (sRGB) or uint8, as PNG (RFC 2083, filter 0).

    bits: 8, or 16 for floats. level: of zlib, 1 fast to 9 small.
    """
    if image.ndim != 3 or image.shape[2] not in (3, 4) or 0 in image.shape:
        raise ValueError(f"image has shape {image.shape}, expected (H, W, 3 or 4)")
    whole = np.dtype(f">u{bits // 8}")
    pixels = image if image.dtype == np.uint8 else np.rint(np.clip(image, 0.0, 1.0) * (2**bits - 1)).astype(whole)
    height, width, channels = pixels.shape
    # The leading zero of each row: no filter.
    rows = np.zeros((height, 1 + width * channels * pixels.itemsize), np.uint8)
    rows[:, 1:] = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    depth = 8 * pixels.itemsize
    header = struct.pack(">IIBBBBB", width, height, depth, 2 if channels == 3 else 6, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), level)) + chunk(b"IEND", b"")
    write_atomically(path, lambda file: file.write(b"\x89PNG\r\n\x1a\n" + body))


def read_png(path: Path) -> NDArray[np.uint8]:
    """The pixels (H, W, 3 or 4) of a PNG that `write_png` wrote with 8 bits; not of PNGs in general.

    Raises:
        OSError: it cannot be read. ValueError: it is another kind of file, or not whole.
    """
    data = path.read_bytes()
    try:
        width, height, depth, kind = struct.unpack_from(">IIBB", data, 16)
        (size,) = struct.unpack_from(">I", data, 33)
        channels = {2: 3, 6: 4}[kind]
        rows = np.frombuffer(zlib.decompress(data[41 : 41 + size]), np.uint8).reshape(height, 1 + width * channels)
        if data[:4] != b"\x89PNG" or data[37:41] != b"IDAT" or depth != 8 or rows[:, 0].any():
            raise ValueError("another kind of PNG")
    except (struct.error, KeyError, zlib.error, ValueError) as error:
        raise ValueError(f"'{path}' is no PNG of ours ({first_line(error)})") from None
    return rows[:, 1:].reshape(height, width, channels)
