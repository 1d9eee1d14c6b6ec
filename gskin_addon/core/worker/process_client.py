# SPDX-License-Identifier: GPL-3.0-or-later
"""Starting, following and stopping a process that tells its progress in lines of JSON. Standard library only."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

from ..errors import Cancelled
from ..job.progress import ProgressEvent
from .spawn import spawn

State = Literal["new", "running", "done", "failed", "cancelled"]


class ProcessClient(ABC):
    """One run of a process. Only `start`, `stop` and `_follow` may take longer than an instant.

    The process writes objects with a "stage" to stdout; "done" or "error" is the last of them, "log" holds a "line" for
    the log, and whatever else comes on stdout or stderr is for the log, too. A closed stdin asks it to stop.
    """

    KILL_AFTER = 0.5
    """Seconds after `cancel` at which what is still there is killed."""

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], *, gentle: bool = False, group: bool = False
    ) -> None:
        """gentle: at low priority, so that a window stays responsive meanwhile.

        group: the process starts others, which are killed along with it.
        """
        self.state: State = "new"
        self.exit_code = 0
        self._command, self._environment = list(command), dict(environment)
        self._gentle, self._group = gentle, group
        self._process: subprocess.Popen[bytes] | None = None
        self._lines: queue.Queue[dict[str, Any] | str | int] = queue.Queue()
        self._log: deque[str] = deque(maxlen=200)
        self._final: dict[str, Any] = {}
        self._cancel_asked = False

    @property
    def cancelling(self) -> bool:
        """Whether it was asked to stop and is still there."""
        return self._cancel_asked and self.state == "running"

    def start(self) -> None:
        """Start the process.

        Raises:
            InputError: the interpreter cannot be started.
        """
        if self._process is not None:
            raise RuntimeError(f"a {type(self).__name__} runs once")
        try:
            self._process = spawn(self._command, self._environment, gentle=self._gentle, group=self._group)
        except OSError as error:
            raise self._cannot_start(error) from error
        self.state = "running"
        log = threading.Thread(target=self._read_log, args=(self._process,), name="gskin-log", daemon=True)
        log.start()
        lines = threading.Thread(
            target=self._read_lines, args=(self._process, log), name="gskin-lines", daemon=True
        )
        lines.start()

    def poll(self) -> list[ProgressEvent]:
        """The progress since the last call; moves `state` and the log on. Never waits."""
        events: list[ProgressEvent] = []
        while True:
            try:
                item = self._lines.get_nowait()
            except queue.Empty:
                return events
            if isinstance(item, int):
                self._end(item)
            elif isinstance(item, str):
                self._log.append(item)
            elif item["stage"] == "log":
                self._log.append(str(item.get("line", "")))
            elif item["stage"] in ("done", "error"):
                self._final = item
            else:
                events.append(self._event(item))

    def cancel(self) -> None:
        """Ask the process to stop; it is gone within a second. Never waits: follow `state` with `poll`."""
        process = self._process
        if process is None or self._cancel_asked:
            return
        self._cancel_asked = True
        with contextlib.suppress(OSError):
            process.stdin.close()  # type: ignore[union-attr]
        killer = threading.Timer(self.KILL_AFTER, self._kill, (process,))
        killer.daemon = True
        killer.start()

    def stop(self) -> None:
        """Cancel, and wait (about a second at most) until the process is gone."""
        self.cancel()
        until = time.monotonic() + self.KILL_AFTER + 3.0
        while self.state == "running" and time.monotonic() < until:
            self.poll()
            time.sleep(0.01)

    def _follow(self, on_progress: Callable[[ProgressEvent], None] | None, interval: float) -> None:
        """Follow the process to its end; an error here (Ctrl-C) stops it."""
        try:
            while self.state == "running":
                for event in self.poll():
                    if on_progress is not None:
                        on_progress(event)
                if self.state == "running":
                    time.sleep(interval)
        except BaseException:  # Ctrl-C and exits too: the process must not outlive its caller; passed on
            self.stop()
            raise

    @abstractmethod
    def _cannot_start(self, error: OSError) -> Exception:
        """What `start` raises where the system cannot start the command."""

    @abstractmethod
    def _ended(self, code: int) -> None:
        """`state` is "done", "failed" or "cancelled" from now on; code: what the process exited with."""

    def _event(self, line: dict[str, Any]) -> ProgressEvent:
        """A line of progress."""
        left = line.get("seconds_left")
        return ProgressEvent(
            stage=str(line["stage"]),
            fraction=float(line.get("fraction") or 0.0),
            seconds_left=None if left is None else float(left),
            losses=dict(line.get("losses") or {}),
            message=str(line.get("message") or ""),
        )

    def _last_word(self) -> str:
        """The last line of the log."""
        return next((line.strip() for line in reversed(self._log) if line.strip()), "it said nothing")

    def _end(self, code: int) -> None:
        self.exit_code = int(self._final.get("exit_code", code))
        if self._final.get("stage") == "done" and code == 0:
            self.state = "done"
        elif self._cancel_asked or self.exit_code == Cancelled.exit_code:
            self.state, self.exit_code = "cancelled", Cancelled.exit_code
        else:
            self.state = "failed"
            self.exit_code = self.exit_code if self.exit_code in (1, 2) else 1
        self._ended(code)

    def _read_lines(self, process: subprocess.Popen[bytes], log: threading.Thread) -> None:
        assert process.stdout is not None
        for raw in process.stdout:
            text = raw.decode(errors="replace").rstrip()
            try:
                line = json.loads(text)
            except ValueError:
                line = None
            told = isinstance(line, dict) and isinstance(line.get("stage"), str)
            self._lines.put(line if told else text)
        if self._group and hasattr(os, "waitid"):
            # While the number is still its own: whatever it may have left behind.
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
            self._kill(process)
        code = process.wait()
        log.join(timeout=0.5)
        self._lines.put(code)

    def _read_log(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stderr is not None
        for raw in process.stderr:
            self._lines.put(raw.decode(errors="replace").rstrip())

    def _kill(self, process: subprocess.Popen[bytes]) -> None:
        if process.returncode is not None:
            return
        with contextlib.suppress(OSError):  # gone already
            if self._group and os.name == "posix":
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
