# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames drawn by another process, while Blender goes on. Nothing here waits but `close`."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import threading
from collections import deque
from pathlib import Path
from typing import Any

from ..errors import GSkinError, InputError
from ..render.frame import Frame
from ..render.output import Output
from .frame_pipe import pack_frame
from .interpreter import VARIABLE, worker_environment
from .spawn import spawn

PROGRAM = Path(__file__).with_name("process.py")


class FrameClient:
    """A process that draws the frames that it is given, one after the other, into files."""

    def __init__(self, python: Path, *, isolated: bool = False, gentle: bool = False) -> None:
        """Start it. Raises InputError where the interpreter cannot be started."""
        self.python = python
        try:
            arguments = [str(PROGRAM), "--draw"]
            command = [str(python), *(["-I"] if isolated else []), "-u", *arguments]
            self._process = spawn(command, worker_environment(), gentle=gentle)
        except OSError as error:
            raise InputError(
                f"'{python}' cannot be started to draw splats ({error.strerror}); name another Python in the add-on's "
                "preferences.",
                terminal=f"or {VARIABLE}",
            ) from error
        self._todo: queue.Queue[list[bytes | memoryview] | None] = queue.Queue()
        self._lines: queue.Queue[dict[str, Any]] = queue.Queue()
        self._log: deque[str] = deque(maxlen=50)
        self._stopped = False
        for work in (self._write, self._read, self._read_log):
            threading.Thread(target=work, args=(self._process,), name="gskin-draw", daemon=True).start()

    def draw(self, number: int, frame: Frame, output: Output) -> None:
        """Have a frame drawn; `poll` tells when its file is there."""
        self._todo.put(pack_frame(number, frame, output))

    def poll(self) -> list[dict[str, Any]]:
        """What the process said since the last call, "compiling", "drawing" and "drawn" lines.

        Raises:
            GSkinError: it failed or is gone; the sentence says why.
        """
        lines: list[dict[str, Any]] = []
        while True:
            try:
                line = self._lines.get_nowait()
            except queue.Empty:
                return lines
            if line["stage"] == "error" and not self._stopped:
                raise GSkinError(str(line["error"]))
            lines.append(line)

    def stop(self) -> None:
        """End the process at once; a file is written whole or not at all."""
        self._stopped = True
        self._todo.put(None)
        if self._process.poll() is None:
            with contextlib.suppress(OSError):
                self._process.kill()

    def close(self) -> None:
        """Stop, and wait until the process is gone."""
        self.stop()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(5.0)

    def _write(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # it is gone: `_read` tells
            while (pieces := self._todo.get()) is not None:
                for piece in pieces:
                    process.stdin.write(piece)
                process.stdin.flush()
        with contextlib.suppress(OSError):
            process.stdin.close()

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        failed = False
        for raw in process.stdout:
            try:
                line = json.loads(raw)
            except ValueError:
                continue
            failed = failed or line.get("stage") == "error"
            self._lines.put(line)
        code = process.wait()
        if not failed and code:
            last = next((text for text in reversed(self._log) if text.strip()), "it said nothing")
            sentence = f"'{self.python}' stopped drawing splats (exit code {code}): {last}"[:400]
            self._lines.put({"stage": "error", "error": sentence + " - check the interpreter in the preferences."})

    def _read_log(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stderr is not None
        for raw in process.stderr:
            self._log.append(raw.decode(errors="replace").rstrip())
