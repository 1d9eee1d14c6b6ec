# SPDX-License-Identifier: GPL-3.0-or-later
"""Messages of the command line. All of them go to stderr."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator


def print_message(sentence: str, details: str = "") -> None:
    """Print one line for the user, after `details` (a traceback)."""
    text = f"{details.rstrip()}\n{sentence}\n" if details else f"{sentence}\n"
    sys.stderr.write(text)
    sys.stderr.flush()


@contextlib.contextmanager
def quiet_stdout() -> Iterator[None]:
    """Send stdout, also that of Blender's C code, nowhere: importers and file operations chatter there."""
    sys.stdout.flush()
    try:
        kept = os.dup(1)
    except OSError:  # no stdout at all
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        sys.stdout.flush()
        if os.name == "posix":
            ctypes.CDLL(None).fflush(None)  # what C has buffered goes the same way
        os.dup2(kept, 1)
        os.close(nowhere)
        os.close(kept)
