# SPDX-License-Identifier: GPL-3.0-or-later
"""What the command line says while it works. All of it goes to stderr."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict
from typing import TextIO

from ..core.worker.client import ProgressEvent

_WIDTH = 28


def say(sentence: str, details: str = "") -> None:
    """One line for the person; `details` (a traceback) before it."""
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


class ProgressPrinter:
    """Shows progress events as a bar on one line ("bar"), as lines, as JSON lines, or not at all ("none").

    "auto" is a bar on a terminal and lines elsewhere.
    """

    def __init__(self, mode: str = "auto", stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        if mode == "auto":
            mode = "bar" if self._stream.isatty() else "lines"
        self._mode = mode
        self._last: tuple[str, int] | None = None
        self._open_line = 0

    def __call__(self, event: ProgressEvent) -> None:
        """Show `event`; lines appear at a new stage and at every tenth of the whole."""
        if self._mode == "json":
            self._write(json.dumps(asdict(event)) + "\n")
        elif self._mode == "bar":
            full = round(_WIDTH * event.fraction)
            text = f"[{'#' * full}{'.' * (_WIDTH - full)}] {describe(event)}"
            self._write("\r" + text.ljust(self._open_line))
            self._open_line = len(text)
        elif self._mode == "lines":
            mark = (event.stage, int(event.fraction * 10))
            if mark != self._last:
                self._last = mark
                self._write(describe(event) + "\n")

    def close(self) -> None:
        """End an open bar, so that what follows has a line of its own."""
        if self._open_line:
            self._write("\n")
            self._open_line = 0

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def describe(event: ProgressEvent) -> str:
    """ " 42 %  learn weights, 1:05 left" """
    text = f"{event.fraction * 100:3.0f} %  {event.stage}"
    if event.message:
        text += f": {event.message}"
    if event.seconds_left is not None and event.seconds_left >= 1:
        minutes, seconds = divmod(round(event.seconds_left), 60)
        text += f", {minutes}:{seconds:02d} left"
    return text
