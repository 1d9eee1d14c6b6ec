# SPDX-License-Identifier: GPL-3.0-or-later
"""Starting, following and cancelling an installation of the learning runtime from Blender or the command line."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from ..errors import Cancelled, GSkinError, InputError
from ..job.progress import ProgressEvent
from .interpreter import worker_environment
from .own_python import own_python
from .process_client import ProcessClient
from .runtime_choice import Choice

PROGRAM = Path(__file__).with_name("runtime_setup.py")


class RuntimeClient(ProcessClient):
    """One installation or repair. `poll` and `cancel` never wait; it dies with this process."""

    def __init__(
        self,
        action: Literal["install", "repair"],
        folder: Path,
        choice: Choice,
        python: str | Path = "",
        program: Path = PROGRAM,
    ) -> None:
        self.folder, self.choice = folder, choice
        self.progress = ProgressEvent("prepare")
        self.sentence = ""
        python = str(python) or base_python()
        command = [python, "-I", "-u", str(program), action, f"--folder={folder}", *choice.arguments()]
        super().__init__(command, worker_environment(), gentle=True, group=True)

    @property
    def log(self) -> deque[str]:
        """The last lines that pip and all wrote, as of the last `poll`."""
        return self._log

    def wait(self, on_progress: Callable[[ProgressEvent], None] | None = None, interval: float = 0.1) -> str:
        """Follow it to its end and return its sentence; an error here (Ctrl-C) stops it.

        Raises:
            Cancelled, GSkinError, InputError: as it ended.
        """
        self._follow(on_progress, interval)
        if self.state == "done":
            return self.sentence
        if self.state == "cancelled":
            raise Cancelled(self.sentence)
        raise InputError(self.sentence) if self.exit_code == 2 else GSkinError(self.sentence)

    def _cannot_start(self, error: OSError) -> InputError:
        return InputError(f"The Python '{self._command[0]}' cannot be started ({error.strerror}); name another one.")

    def _event(self, line: dict[str, Any]) -> ProgressEvent:
        message = str(line.get("message") or self.progress.message)
        self.progress = super()._event({**line, "message": message})
        return self.progress

    def _ended(self, code: int) -> None:
        if self.state == "done":
            self.sentence = str(self._final.get("message") or "Done.")
        elif self.state == "cancelled":
            self.sentence = "The installation was cancelled; started again, it goes on from there."
        else:
            self.sentence = str(self._final.get("error") or "") or (
                f"The installation ended without a word (exit code {code}): {self._last_word()[:200]} - try again, "
                "or repair it."
            )


def base_python() -> str:
    """The interpreter that makes the environment: this one's program. Blender's own sets sys.executable to it."""
    own = own_python()
    if own is not None:
        return str(own)
    raise InputError(
        "Blender's own Python program was not found; make an environment yourself and name it under Python with torch."
    )
