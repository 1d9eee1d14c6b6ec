# SPDX-License-Identifier: GPL-3.0-or-later
"""A thread that sorts and colours splats while Blender goes on. It never touches Blender."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from typing import Any

Job = Callable[[], Any]


class Sorter:
    """Runs the newest job of each asker, one at a time; results wait to be taken."""

    def __init__(self) -> None:
        self._wake = threading.Condition()
        self._jobs: dict[Hashable, tuple[Hashable, Job]] = {}
        self._running: tuple[Hashable, Hashable] | None = None
        self._done: dict[Hashable, tuple[Any, Any]] = {}
        self._thread: threading.Thread | None = None

    def ask(self, asker: Hashable, key: Hashable, job: Job) -> None:
        """Have `job` run, in place of one that waits; nothing new if one for `key` waits, runs or is done."""
        with self._wake:
            waiting, done = self._jobs.get(asker), self._done.get(asker)
            if (waiting and waiting[0] == key) or self._running == (asker, key) or (done and done[0] == key):
                return
            self._jobs[asker] = key, job
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="gskin-sorter", daemon=True)
                self._thread.start()
            self._wake.notify()

    def take(self, asker: Hashable) -> tuple[Any, Any] | None:
        """(key, result) of the last job done for an asker, once; an exception of the job is raised here."""
        with self._wake:
            done = self._done.pop(asker, None)
        if done is not None and isinstance(done[1], Exception):
            raise done[1]
        return done

    def has_results(self) -> bool:
        """Whether a result waits to be taken."""
        with self._wake:
            return bool(self._done)

    def is_busy(self) -> bool:
        """Whether a job waits or runs."""
        with self._wake:
            return bool(self._jobs) or self._running is not None

    def forget(self) -> None:
        """Drop waiting jobs and results; the thread ends after the job that it may be in."""
        with self._wake:
            self._jobs.clear()
            self._done.clear()
            self._wake.notify()
            self._thread = None

    def _work(self) -> None:
        me = threading.current_thread()
        while True:
            with self._wake:
                while not self._jobs and self._thread is me:
                    self._wake.wait()
                if self._thread is not me:
                    return
                asker = next(iter(self._jobs))
                key, job = self._jobs.pop(asker)
                self._running = asker, key
            try:
                result = job()
            except Exception as error:  # raised again where it is taken
                result = error
            with self._wake:
                self._running = None
                if self._thread is me:
                    self._done[asker] = key, result
