# SPDX-License-Identifier: GPL-3.0-or-later
"""Starting, following and cancelling an installation of the learning runtime from Blender or the command line."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from ..errors import Cancelled, GSkinError, InputError
from ..job.progress import ProgressEvent
from .interpreter import worker_environment
from .own_python import own_python
from .runtime_choice import Choice

PROGRAM = Path(__file__).with_name("runtime_setup.py")


class RuntimeClient:
    """One installation or repair. `poll` and `cancel` never wait; it dies with this process."""

    KILL_AFTER = 0.5
    """Seconds after `cancel` at which processes that are still there are killed."""

    def __init__(
        self,
        action: Literal["install", "repair"],
        folder: Path,
        choice: Choice,
        python: str | Path = "",
        program: Path = PROGRAM,
    ) -> None:
        self.folder, self.choice = folder, choice
        self.state: Literal["new", "running", "done", "failed", "cancelled"] = "new"
        self.progress = ProgressEvent("prepare")
        self.sentence = ""
        self.log: deque[str] = deque(maxlen=200)
        self.exit_code = 0
        python = str(python) or base_python()
        arguments = [action, f"--folder={folder}", *choice.arguments()]
        self._command = [python, "-I", "-u", str(program), *arguments]
        self._process: subprocess.Popen[bytes] | None = None
        self._lines: queue.Queue[dict[str, Any] | int] = queue.Queue()
        self._final: dict[str, Any] = {}
        self._cancel_asked = False

    @property
    def cancelling(self) -> bool:
        """Whether it was asked to stop and is still there."""
        return self._cancel_asked and self.state == "running"

    def start(self) -> None:
        """Start the process. Raises InputError where the interpreter cannot be started."""
        if self._process is not None:
            raise RuntimeError("a RuntimeClient runs once")
        flags = getattr(subprocess, "CREATE_NO_WINDOW", 0) | getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
        try:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                env=worker_environment(), start_new_session=os.name == "posix", creationflags=flags,
            )  # fmt: skip
        except OSError as error:
            raise InputError(
                f"The Python '{self._command[0]}' cannot be started ({error.strerror}); name another one."
            ) from error
        self.state = "running"
        threading.Thread(target=self._read, args=(self._process,), name="gskin-runtime", daemon=True).start()

    def poll(self) -> list[ProgressEvent]:
        """What was said since the last call; moves `state`, `progress` and `log` on."""
        events: list[ProgressEvent] = []
        while True:
            try:
                item = self._lines.get_nowait()
            except queue.Empty:
                return events
            if isinstance(item, int):
                self._ended(item)
            elif item.get("stage") == "log":
                self.log.append(str(item.get("line", "")))
            elif item.get("stage") in ("done", "error"):
                self._final = item
            else:
                message = str(item.get("message") or self.progress.message)
                self.progress = ProgressEvent(str(item["stage"]), float(item.get("fraction") or 0.0), message=message)
                events.append(self.progress)

    def cancel(self) -> None:
        """Ask it to stop; pip and all are gone within a second. Never waits: follow `state` with `poll`."""
        process = self._process
        if process is None or self._cancel_asked:
            return
        self._cancel_asked = True
        with contextlib.suppress(OSError):
            process.stdin.close()  # type: ignore[union-attr]
        killer = threading.Timer(self.KILL_AFTER, _kill_group, (process,))
        killer.daemon = True
        killer.start()

    def wait(self, on_progress: Callable[[ProgressEvent], None] | None = None, interval: float = 0.1) -> str:
        """Follow it to its end and return its sentence; an error here (Ctrl-C) stops it.

        Raises:
            Cancelled, GSkinError, InputError: as it ended.
        """
        try:
            while self.state == "running":
                for event in self.poll():
                    if on_progress is not None:
                        on_progress(event)
                if self.state == "running":
                    time.sleep(interval)
        except BaseException:  # Ctrl-C and exits too; passed on
            self.cancel()
            until = time.monotonic() + 2.0
            while self.state == "running" and time.monotonic() < until:
                self.poll()
                time.sleep(0.02)
            raise
        if self.state == "done":
            return self.sentence
        if self.state == "cancelled":
            raise Cancelled(self.sentence)
        raise InputError(self.sentence) if self.exit_code == 2 else GSkinError(self.sentence)

    def _ended(self, code: int) -> None:
        self.exit_code = int(self._final.get("exit_code", code))
        if self._final.get("stage") == "done" and code == 0:
            self.state, self.sentence = "done", str(self._final.get("message") or "Done.")
            return
        self.sentence = str(self._final.get("error") or "")
        if self._cancel_asked or self.exit_code == Cancelled.exit_code:
            self.state, self.exit_code = "cancelled", Cancelled.exit_code
            self.sentence = "The installation was cancelled; started again, it goes on from there."
        else:
            self.state = "failed"
            last = next((line.strip() for line in reversed(self.log) if line.strip()), "it said nothing")
            self.sentence = self.sentence or (
                f"The installation ended without a word (exit code {code}): {last[:200]} - try again, or repair it."
            )

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        for raw in process.stdout:
            text = raw.decode(errors="replace").rstrip()
            try:
                line = json.loads(text)
            except ValueError:
                line = None
            if isinstance(line, dict) and isinstance(line.get("stage"), str):
                self._lines.put(line)
            else:
                self._lines.put({"stage": "log", "line": text})
        if hasattr(os, "waitid"):  # while the number is still its own: whatever it may have left behind
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
            _kill_group(process)
        self._lines.put(process.wait())


def base_python() -> str:
    """The interpreter that makes the environment: this one's program. Blender's own sets sys.executable to it."""
    own = own_python()
    if own is not None:
        return str(own)
    raise InputError(
        "Blender's own Python program was not found; make an environment yourself and name it under Python with torch."
    )


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    if process.returncode is not None:
        return
    with contextlib.suppress(OSError):  # gone already
        if os.name == "posix":
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
