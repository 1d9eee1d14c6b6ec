# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress as text: a bar, lines or JSON lines for a terminal, and the time left as a person says it."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from typing import TextIO

from .progress import ProgressEvent

_WIDTH = 28


def time_left(seconds: float | None) -> str:
    """Remaining time as a person says it."""
    if seconds is None:
        return "estimating time"
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02} min left"
    return f"{whole // 60}:{whole % 60:02} left"


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
