# SPDX-License-Identifier: GPL-3.0-or-later
"""Starting, following and stopping a worker from another program, Blender above all. numpy only.

client = WorkerClient(find_worker_python(), folder)
client.start()
while client.state == "running":
    for progress in client.poll(): ...      # from a timer; never waits
client.result().weights
"""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from ..errors import Cancelled, GSkinError, InputError
from ..guidance.consent import with_consent
from ..job.contract import Result, read_result
from ..job.progress import ProgressEvent
from .interpreter import VARIABLE, worker_environment
from .spawn import spawn

PROGRAM = Path(__file__).with_name("process.py")

State = Literal["new", "running", "done", "failed", "cancelled"]


class WorkerError(GSkinError):
    """The worker failed: its sentence (`plain`: without flags), its traceback (may be empty) and its exit code."""

    def __init__(self, sentence: str, traceback: str, exit_code: int, plain: str = "") -> None:
        super().__init__(sentence)
        self.plain = plain or sentence
        self.traceback = traceback
        self.exit_code = exit_code


class WorkerClient:
    """One run of the worker on one job folder.

    Only `start`, `wait`, `stop` and `result` may take longer than an instant; `poll` and `cancel` never wait.
    The worker dies with this process, and with the thread that called `start` (Linux).
    """

    KILL_AFTER = 0.5
    """Seconds after `cancel` at which a worker that is still there is killed."""

    def __init__(
        self,
        python: str | Path,
        folder: str | Path,
        program: Path = PROGRAM,
        *,
        isolated: bool = False,
        gentle: bool = False,
        allow_download: bool = False,
    ) -> None:
        """isolated: the worker sees nothing of the user's own Python packages and PYTHON... variables.

        gentle: the worker runs at low priority, so that a window stays responsive meanwhile.

        allow_download: the person agreed, for this run, to fetch models that are missing.
        """
        self.python, self.folder = Path(python), Path(folder)
        self._isolated, self._gentle, self._allow_download = isolated, gentle, allow_download
        self.state: State = "new"
        self.error = self._plain = ""
        self.traceback = ""
        self.exit_code = 0
        self._program = program
        self._process: subprocess.Popen[bytes] | None = None
        self._lines: queue.Queue[dict[str, Any] | int] = queue.Queue()
        self._log: deque[str] = deque(maxlen=200)
        self._final: dict[str, Any] = {}
        self._cancel_asked = False

    def start(self) -> None:
        """Start the process.

        Raises:
            InputError: the interpreter cannot be started.
        """
        if self._process is not None:
            raise RuntimeError("a WorkerClient runs once")
        environment = with_consent(worker_environment(), self._allow_download)
        program = [str(self._program), str(self.folder)]
        try:
            self._process = spawn(
                self.python, program, environment, isolated=self._isolated, gentle=self._gentle
            )
        except OSError as error:
            raise InputError(
                f"The worker's interpreter '{self.python}' cannot be started ({error.strerror}); "
                "name a Python that has torch in the add-on's preferences.",
                terminal=f"or {VARIABLE}",
            ) from error
        self.state = "running"
        log = threading.Thread(target=self._read_log, args=(self._process,), name="gskin-log", daemon=True)
        log.start()
        lines = threading.Thread(
            target=self._read_lines, args=(self._process, log), name="gskin-lines", daemon=True
        )
        lines.start()

    def poll(self) -> list[ProgressEvent]:
        """The worker's progress since the last call; updates `state`. Never waits."""
        events: list[ProgressEvent] = []
        while True:
            try:
                item = self._lines.get_nowait()
            except queue.Empty:
                return events
            if isinstance(item, int):
                self._ended(item)
            elif item.get("stage") in ("done", "error"):
                self._final = item
            else:
                events.append(_event(item))

    def cancel(self) -> None:
        """Ask the worker to stop; it is gone within a second. Never waits: follow `state` with `poll`."""
        process = self._process
        if process is None or self._cancel_asked:
            return
        self._cancel_asked = True
        with contextlib.suppress(OSError):
            process.stdin.close()  # type: ignore[union-attr]
        killer = threading.Timer(self.KILL_AFTER, _kill, (process,))
        killer.daemon = True
        killer.start()

    def wait(
        self, on_progress: Callable[[ProgressEvent], None] | None = None, interval: float = 0.1
    ) -> Result:
        """Follow the worker to its end and return the result; an error here (Ctrl-C) stops it.

        Raises as `result`.
        """
        try:
            while self.state == "running":
                for event in self.poll():
                    if on_progress is not None:
                        on_progress(event)
                if self.state == "running":
                    time.sleep(interval)
        except BaseException:  # Ctrl-C and exits too: the worker must not outlive its caller; passed on
            self.stop()
            raise
        return self.result()

    def stop(self) -> None:
        """Cancel, and wait (about a second at most) until the worker is gone."""
        self.cancel()
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(self.KILL_AFTER + 2.0)
            until = time.monotonic() + 1.0
            while self.state == "running" and time.monotonic() < until:
                self.poll()
                time.sleep(0.01)

    def result(self) -> Result:
        """The weights and the report of a job that ended well.

        Raises:
            Cancelled: it was cancelled. WorkerError: it failed. GSkinError: it still runs.
            InputError: the result's files are damaged.
        """
        if self.state == "cancelled":
            raise Cancelled("The job was cancelled.")
        if self.state == "failed":
            raise WorkerError(self.error, self.traceback, self.exit_code, self._plain)
        if self.state != "done":
            raise GSkinError("The job has not ended yet; wait for it.")
        return read_result(self.folder)

    @property
    def log(self) -> str:
        """The last lines that the worker and its libraries wrote to stderr."""
        return "\n".join(self._log)

    def _ended(self, code: int) -> None:
        self.exit_code = int(self._final.get("exit_code", code))
        if self._final.get("stage") == "done" and code == 0:
            self.state = "done"
        elif self._cancel_asked or self.exit_code == 130:
            self.state, self.exit_code = "cancelled", 130
            self.error = "The job was cancelled."
        else:
            self.state = "failed"
            self.exit_code = self.exit_code if self.exit_code in (1, 2) else 1
            self.traceback = str(self._final.get("traceback") or self.log)
            unexplained = self._unexplained(code)
            self.error = str(self._final.get("error") or unexplained)
            self._plain = str(self._final.get("plain") or self._final.get("error") or unexplained.plain)

    def _unexplained(self, code: int) -> GSkinError:
        last = next((line.strip() for line in reversed(self._log) if line.strip()), "it said nothing")
        return GSkinError(
            f"The worker '{self.python}' ended without a result (exit code {code}): {last}"[:400]
            + " - check the interpreter in the add-on's preferences.",
            terminal=f"or {VARIABLE}",
        )

    def _read_lines(self, process: subprocess.Popen[bytes], log: threading.Thread) -> None:
        assert process.stdout is not None
        for raw in process.stdout:
            try:
                line = json.loads(raw)
            except ValueError:
                line = None
            if isinstance(line, dict) and isinstance(line.get("stage"), str):
                self._lines.put(line)
            else:
                self._log.append(raw.decode(errors="replace").rstrip())
        code = process.wait()
        log.join(timeout=0.5)
        self._lines.put(code)

    def _read_log(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stderr is not None
        for raw in process.stderr:
            self._log.append(raw.decode(errors="replace").rstrip())


def _event(line: dict[str, Any]) -> ProgressEvent:
    left = line.get("seconds_left")
    return ProgressEvent(
        stage=str(line["stage"]),
        fraction=float(line.get("fraction") or 0.0),
        seconds_left=None if left is None else float(left),
        losses=dict(line.get("losses") or {}),
        message=str(line.get("message") or ""),
    )


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        with contextlib.suppress(OSError):
            process.kill()
