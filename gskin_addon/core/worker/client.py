# SPDX-License-Identifier: GPL-3.0-or-later
"""Starting, following and stopping a worker from another program, Blender above all. numpy only.

client = WorkerClient(find_worker_python(), folder)
client.start()
while client.state == "running":
    for progress in client.poll(): ...      # from a timer; never waits
client.result().weights
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..errors import Cancelled, GSkinError, InputError
from ..guidance.consent import with_consent
from ..job.contract import Result, read_result
from ..job.progress import ProgressEvent
from .interpreter import VARIABLE, worker_environment
from .process_client import ProcessClient

PROGRAM = Path(__file__).with_name("process.py")


class WorkerError(GSkinError):
    """The worker failed: its sentence (`plain`: without flags), its traceback (may be empty) and its exit code."""

    def __init__(self, sentence: str, traceback: str, exit_code: int, plain: str = "") -> None:
        super().__init__(sentence)
        self.plain = plain or sentence
        self.traceback = traceback
        self.exit_code = exit_code


class WorkerClient(ProcessClient):
    """One run of the worker on one job folder.

    Only `start`, `wait`, `stop` and `result` may take longer than an instant; `poll` and `cancel` never wait.
    The worker dies with this process, and with the thread that called `start` (Linux).
    """

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
        self.error = self._plain = ""
        self.traceback = ""
        command = [str(self.python), *(["-I"] if isolated else []), "-u", str(program), str(self.folder)]
        super().__init__(command, with_consent(worker_environment(), allow_download), gentle=gentle)

    def wait(
        self, on_progress: Callable[[ProgressEvent], None] | None = None, interval: float = 0.1
    ) -> Result:
        """Follow the worker to its end and return the result; an error here (Ctrl-C) stops it.

        Raises as `result`.
        """
        self._follow(on_progress, interval)
        return self.result()

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

    def _cannot_start(self, error: OSError) -> InputError:
        return InputError(
            f"The worker's interpreter '{self.python}' cannot be started ({error.strerror}); "
            "name a Python that has torch in the add-on's preferences.",
            terminal=f"or {VARIABLE}",
        )

    def _ended(self, code: int) -> None:
        if self.state == "cancelled":
            self.error = "The job was cancelled."
        elif self.state == "failed":
            self.traceback = str(self._final.get("traceback") or self.log)
            unexplained = self._unexplained(code)
            self.error = str(self._final.get("error") or unexplained)
            self._plain = str(self._final.get("plain") or self._final.get("error") or unexplained.plain)

    def _unexplained(self, code: int) -> GSkinError:
        return GSkinError(
            f"The worker '{self.python}' ended without a result (exit code {code}): {self._last_word()}"[:400]
            + " - check the interpreter in the add-on's preferences.",
            terminal=f"or {VARIABLE}",
        )
