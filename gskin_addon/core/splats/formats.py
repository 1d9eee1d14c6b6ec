# SPDX-License-Identifier: GPL-3.0-or-later
"""Splat files by what they hold: the one place that knows which formats are read and written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from .cloud import SplatCloud
from .ply import PlySplats, read_ply, write_ply

Reader = Callable[[Path, bool], PlySplats]
"""(file, leave invalid splats out) -> splats with the file's own axes; InputError for what cannot be read."""
Writer = Callable[[Path, SplatCloud], None]
"""Write the splats, whole or not at all."""


@dataclass(frozen=True)
class SplatFormat:
    """suffixes: that its files end in, lower case; magic: the bytes that they start with; read, write."""

    suffixes: tuple[str, ...]
    magic: bytes
    read: Reader
    write: Writer


def _read_ply(path: Path, drop_invalid: bool) -> PlySplats:
    return read_ply(path, drop_invalid=drop_invalid)


FORMATS: dict[str, SplatFormat] = {
    "ply": SplatFormat((".ply",), b"ply", _read_ply, write_ply),
}
"""By name; another format is one file beside `ply.py` and one entry here."""

SUFFIXES = tuple(suffix for form in FORMATS.values() for suffix in form.suffixes)


def read_splats(path: Path, *, drop_invalid: bool = False) -> PlySplats:
    """Read a file of any known format, recognised by its first bytes, else by its name.

    Splats with NaN, infinite values or a quaternion of norm 0 are left out with `drop_invalid`, else an error.

    Raises:
        InputError: no such file, no known format, or a damaged file.
    """
    return _find(path).read(path, drop_invalid)


def write_splats(path: Path, cloud: SplatCloud) -> None:
    """Write the splats in the format that the name of the file asks for.

    Raises:
        InputError: an unknown suffix. GSkinError: the file cannot be written; what was there stays.
    """
    for form in FORMATS.values():
        if path.suffix.lower() in form.suffixes:
            form.write(path, cloud)
            return
    raise InputError(f"'{path}' is no {' or '.join(SUFFIXES)} file; choose another name for the splats.")


def _find(path: Path) -> SplatFormat:
    start = b""
    if path.is_file():
        try:
            with path.open("rb") as file:
                start = file.read(16)
        except OSError as error:
            raise InputError(f"'{path}' cannot be read ({error.strerror or error}); check the path.") from error
    for form in FORMATS.values():
        if start.startswith(form.magic):
            return form
    for form in FORMATS.values():
        if path.suffix.lower() in form.suffixes:
            if not path.is_file():
                raise InputError(f"'{path}' does not exist; check the path of the splats.")
            return form  # its reader says what is wrong with the first bytes
    raise InputError(
        f"'{path}' is no {' or '.join(SUFFIXES)} file; export the splats as a Gaussian splat .ply "
        "(the program splat-transform turns .splat, .ksplat, .spz and .sog files into one)."
    )
