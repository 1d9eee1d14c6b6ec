# SPDX-License-Identifier: GPL-3.0-or-later
"""What the installation's process runs, one at a time, what it says, and how both end at once."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

from ..errors import Cancelled

NO_WINDOW: int = getattr(subprocess, "CREATE_NO_WINDOW", 0)


class LineSender:
    """Writes JSON lines to our stdout, whole ones, from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __call__(self, line: dict[str, Any]) -> None:
        with self._lock, contextlib.suppress(OSError, ValueError):  # nobody reads any more: the pipe says so too
            sys.stdout.write(json.dumps(line) + "\n")
            sys.stdout.flush()


class Children:
    """The one process that runs for us, and its end when we are cancelled."""

    def __init__(self, send: Callable[[dict[str, Any]], None]) -> None:
        self._send = send
        self._process: subprocess.Popen[bytes] | None = None

    def run(self, command: list[str], environment: dict[str, str], hear: Callable[[str], None]) -> int:
        """Run `command`, every line of its output to `hear`; returns the exit code. Raises OSError."""
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment,
            creationflags=NO_WINDOW,
        ) as self._process:  # fmt: skip
            assert self._process.stdout is not None
            for raw in self._process.stdout:
                hear(raw.decode(errors="replace").rstrip())
            return self._process.wait()

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        # Not from here: the interrupted code may hold the lock that the last word needs.
        threading.Thread(target=self.cancel, daemon=True).start()

    def cancel(self) -> None:
        """End the child and us, at once. What is installed and fetched stays for the next run."""
        process = self._process
        if process is not None:
            with contextlib.suppress(OSError):
                process.kill()
        self._send(
            {
                "stage": "error",
                "error": "The installation was cancelled; started again, it goes on from here.",
                "exit_code": Cancelled.exit_code,
            }
        )
        if os.name == "posix" and os.getpgid(0) == os.getpid():
            os.killpg(0, signal.SIGKILL)  # our own group: pip may have started processes of its own
        os._exit(Cancelled.exit_code)
