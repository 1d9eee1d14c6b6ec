# SPDX-License-Identifier: GPL-3.0-or-later
"""The worker's outer process: starts the computing one, passes its lines on, ends it. Standard library only.

A long numba or BLAS call holds Python's lock, so the computing process itself cannot notice a closed pipe, a
signal or its parent's death in time. This process does nothing else and always can; it also sends the last line when
the other is killed or crashes.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from types import FrameType
from typing import Any

from ..job.progress import CancelFlag
from . import parent_watch

GRACE = 0.5
"""Seconds that the computing process has to end by itself after a cancel."""

FINAL_STAGES = ("done", "error")

_POLL = 0.05


def supervise(command: Sequence[str]) -> int:
    """Run `command` to its end, its stdout lines passed to ours; returns the exit code.

    Stops it when a piped stdin closes, on SIGTERM, SIGINT or SIGHUP, when our parent or our reader is gone.
    The last line out is always {"stage": "done"} or {"stage": "error", "error", "traceback", "exit_code"}.
    """
    stop = CancelFlag()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    for name in ("SIGTERM", "SIGINT", "SIGHUP", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), on_signal)
    parent = os.getppid()
    parent_watch.die_with_parent(signal.SIGTERM)
    pipe = parent_watch.take_stdin()
    if pipe is not None:
        parent_watch.on_close(pipe, stop.set)

    child = subprocess.Popen(
        list(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=os.name == "posix"
    )
    relay = _LineRelay(child, stop)
    asked_at: float | None = None
    while child.poll() is None:
        if asked_at is None and (stop.is_set() or (os.name == "posix" and os.getppid() != parent)):
            asked_at = time.monotonic()
            stop.set()
            _close(child.stdin)
        if asked_at is not None and time.monotonic() - asked_at > GRACE:
            child.kill()
        time.sleep(_POLL)
    relay.thread.join(timeout=1.0)
    if not relay.final:
        relay.send(_last_word(child.returncode, stop.is_set()))
    if stop.is_set() and child.returncode != 0:
        return 130
    return child.returncode if child.returncode in (0, 1, 2, 130) and relay.final else 1


class _LineRelay:
    """Copies the child's lines to our stdout, whole lines only, from a thread."""

    def __init__(self, child: subprocess.Popen[bytes], stop: CancelFlag) -> None:
        self.final = False
        self._child, self._stop = child, stop
        self.thread = threading.Thread(target=self._copy, name="gskin-relay", daemon=True)
        self.thread.start()

    def _copy(self) -> None:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            if not line.endswith(b"\n"):
                return  # it died in the middle of a line
            self._write(line)
            with contextlib.suppress(ValueError, AttributeError):
                self.final = self.final or json.loads(line).get("stage") in FINAL_STAGES

    def send(self, line: dict[str, Any]) -> None:
        self._write(json.dumps(line).encode() + b"\n")

    def _write(self, line: bytes) -> None:
        try:
            sys.stdout.buffer.write(line)
            sys.stdout.buffer.flush()
        except (OSError, ValueError):
            self._stop.set()  # nobody reads any more


def _last_word(code: int, stopped: bool) -> dict[str, Any]:
    if stopped:
        return {"stage": "error", "error": "The job was cancelled.", "traceback": "", "exit_code": 130}
    if code < 0:
        name = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
        why = f"was ended by the system ({name})"
        hint = (
            "most likely the memory ran out: close other programs or use a lighter preset"
            if name == "SIGKILL"
            else "see the log above it, and start the job again to go on from its last checkpoint"
        )
    else:
        why, hint = f"ended without a result (exit code {code})", "see the log above it"
    return {"stage": "error", "error": f"The worker {why}; {hint}.", "traceback": "", "exit_code": 1}


def _close(stream: Any) -> None:
    with contextlib.suppress(OSError):
        stream.close()
