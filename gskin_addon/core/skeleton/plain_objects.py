# SPDX-License-Identifier: GPL-3.0-or-later
"""Lists in .npz files that were stored as pickled objects, read without running what a pickle can run.

UniRig keeps the parents of its joints, with None for the root, in this way. The codes are looked at and never run.
"""

from __future__ import annotations

import io
import pickletools
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..errors import InputError

_PLAIN = {
    "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "INT", "LONG", "BINFLOAT",
    "BINUNICODE", "SHORT_BINUNICODE", "UNICODE",
}  # fmt: skip
_LARGEST = 64_000_000


def read_plain(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any] | list[Any]]:
    """Those arrays of an .npz that are there: numbers and texts as arrays, flat lists of objects as lists of None,
    numbers and texts.

    Raises:
        InputError: not readable, damaged, or an array with anything else in it.
    """
    found: dict[str, NDArray[Any] | list[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for name in names:
                if f"{name}.npy" not in archive.namelist():
                    continue
                if archive.getinfo(f"{name}.npy").file_size > _LARGEST:
                    raise ValueError(f"'{name}' is too large")
                found[name] = _read(io.BytesIO(archive.read(f"{name}.npy")))
    except (OSError, ValueError, KeyError, EOFError, IndexError, TypeError, AttributeError, zipfile.BadZipFile,
            NotImplementedError, RuntimeError, MemoryError) as error:  # fmt: skip
        raise InputError(f"'{path}' cannot be read ({error}); write the file again.") from error
    return found


def _read(file: io.BytesIO) -> NDArray[Any] | list[Any]:
    header: Any = npy  # numpy gives its readers no types
    version = header.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError("an array of an unknown version")
    read = header.read_array_header_1_0 if version == (1, 0) else header.read_array_header_2_0
    shape, _, dtype = read(file)
    if not dtype.hasobject:
        file.seek(0)
        array: NDArray[Any] = np.load(file, allow_pickle=False)
        return array
    if len(shape) > 1:
        raise ValueError("a table of objects")
    values = _listed(file.read())
    return values if shape else values[:1]


def _listed(data: bytes) -> list[Any]:
    """The values of the last list in a stored array of objects, told from its codes; none of them is run.

    Raises:
        ValueError: there is no such list, or something else than None, numbers and texts in it.
    """
    codes: list[tuple[str, Any]] = [(code.name, value) for code, value, _ in pickletools.genops(data)]
    begin = max((number for number, (name, _) in enumerate(codes) if name == "EMPTY_LIST"), default=-1)
    if begin < 0:
        raise ValueError("no list of values")
    values: list[Any] = []
    kept: dict[int, Any] = {}
    memo = sum(name == "MEMOIZE" for name, _ in codes[:begin])
    for name, value in codes[begin + 1 :]:
        if name in _PLAIN:
            values.append({"NONE": None, "NEWTRUE": True, "NEWFALSE": False}.get(name, value))
        elif name in ("BINPUT", "LONG_BINPUT", "MEMOIZE"):
            if values:
                kept[memo if name == "MEMOIZE" else int(value)] = values[-1]
            memo += name == "MEMOIZE"
        elif name in ("BINGET", "LONG_BINGET") and int(value) in kept:
            values.append(kept[int(value)])
        elif name == "TUPLE":  # the state of the array ends after its list
            return values
        elif name not in ("MARK", "APPENDS", "APPEND"):
            raise ValueError("a list of something else than numbers and texts")
    raise ValueError("no end of the list of values")
