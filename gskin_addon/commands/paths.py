# SPDX-License-Identifier: GPL-3.0-or-later
"""Output paths, checked before any work is done."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ..core.errors import InputError


def check_output(path: Path, option: str, suffixes: Sequence[str]) -> None:
    """Raise InputError unless a file of one of `suffixes` can be written at `path`."""
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{option} '{path}' must end in {' or '.join(suffixes)}.")
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InputError(f"{option} '{path}' lies in a folder that does not exist; make '{folder}' first.")
    if path.is_dir():
        raise InputError(f"{option} '{path}' is a folder; give the name of a file.")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{option} '{path}' lies in a folder that cannot be written; choose another.")


def same_file(a: Path, b: Path) -> bool:
    """Whether both name the same existing file."""
    return a.exists() and b.exists() and os.path.samefile(a, b)
