# SPDX-License-Identifier: GPL-3.0-or-later
"""Tasks in worker processes that may crash or be stopped by the clock without harm to the run."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from .protocol import Protocol
from .results import Result
from .work import Task, perform

_SPAWN = multiprocessing.get_context("spawn")

PATIENCE = 20.0
"""Wall seconds for a core-second of a method's limit: only what hangs or starves takes longer."""

_OWN_LIMIT = 120.0  # for loading and judging


def run_tasks(
    tasks: Iterable[Task],
    protocol: Protocol,
    folder: Path,
    *,
    jobs: int = 1,
    threads: int = 1,
    lpips: Path | None = None,
    report: Callable[[Result], None],
    missing: Callable[[str, str], None],
) -> None:
    """Do all tasks in `jobs` processes of `threads` threads each.

    report(result) as each comes; missing(method, why) for a method that cannot run here, or on an asset that cannot
    be judged. A worker that dies, by the limit of its core-seconds too, or hangs is replaced; the method that it was at
    has failed on that asset.
    """
    waiting = deque(tasks)
    workers: list[_Worker] = []
    try:
        while waiting or workers:
            while waiting and len(workers) < jobs:
                with _threads_of_children(threads):
                    workers.append(_Worker(protocol, folder, lpips))
                workers[-1].begin(waiting.popleft())
            wait([worker.pipe for worker in workers], timeout=1.0)
            for worker in list(workers):
                left = worker.listen(report, missing)
                if left is not None:
                    workers.remove(worker)
                    if left.methods or left.failed:
                        waiting.appendleft(left)
                elif worker.idle:
                    if waiting:
                        worker.begin(waiting.popleft())
                    else:
                        worker.close()
                        workers.remove(worker)
    finally:
        for worker in workers:
            worker.close()


@contextmanager
def _threads_of_children(count: int) -> Iterator[None]:
    """Processes started within take `count` threads each; this one's own environment comes back."""
    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, str(count)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@dataclass
class _At:
    """What a worker is at, its limit in core-seconds, and until when it may be."""

    method: str
    limit: float
    until: float

    @classmethod
    def now(cls, method: str, limit: float) -> _At:
        return cls(method, limit, time.monotonic() + PATIENCE * limit)


class _Worker:
    def __init__(self, protocol: Protocol, folder: Path, lpips: Path | None) -> None:
        self.pipe, other = _SPAWN.Pipe()
        self._process = _SPAWN.Process(target=_work, args=(other, protocol, folder, lpips), daemon=True)
        self._process.start()
        other.close()
        self._task: Task | None = None
        self._at = _At.now("", 0.0)

    @property
    def idle(self) -> bool:
        return self._task is None

    def begin(self, task: Task) -> None:
        self._task = task
        self._at = _At.now("(starting)", _OWN_LIMIT)
        self.pipe.send(task)

    def listen(
        self, report: Callable[[Result], None], missing: Callable[[str, str], None]
    ) -> Task | None:
        """Take in what the worker says; what is left of its task where it is no more."""
        try:
            while self.pipe.poll():
                self._hear(self.pipe.recv(), report, missing)
        except (EOFError, OSError):
            self._process.join(5.0)
            code = self._process.exitcode
            slow = f"took longer than {self._at.limit:.0f} core-seconds"
            return self._lost(slow if code == -signal.SIGXCPU else f"its process ended (code {code})", missing)
        if not self.idle and time.monotonic() > self._at.until:
            self.close()
            return self._lost(f"hung for {PATIENCE * self._at.limit:.0f} s", missing)
        return None

    def _hear(
        self, message: tuple[Any, ...], report: Callable[[Result], None], missing: Callable[[str, str], None]
    ) -> None:
        kind = message[0]
        if kind == "start":
            self._at = _At.now(message[1], message[2])
        elif kind == "made":
            self._at = _At.now(f"judging {message[1]}", _OWN_LIMIT)
        elif kind == "done":
            self._task = None
        elif kind == "unavailable":
            self._drop(message[1])
            missing(message[1], message[2])
        else:
            self._drop(message[1].method)
            report(message[1])

    def _drop(self, method: str) -> None:
        assert self._task is not None
        self._task = replace(
            self._task,
            methods=tuple(m for m in self._task.methods if m != method),
            failed=tuple(f for f in self._task.failed if f[0] != method),
        )

    def _lost(self, why: str, missing: Callable[[str, str], None]) -> Task:
        """The rest of the task, with what the worker was at among the failed; nothing, where it was no method."""
        assert self._task is not None
        if self._at.method not in self._task.methods:
            for method in (*self._task.methods, *(name for name, _ in self._task.failed)):
                missing(method, f"{self._task.asset} cannot be judged, {self._at.method} {why}")
            return replace(self._task, methods=(), failed=())
        rest = tuple(m for m in self._task.methods if m != self._at.method)
        return replace(self._task, methods=rest, failed=(*self._task.failed, (self._at.method, why)))

    def close(self) -> None:
        self.pipe.close()
        self._process.terminate()
        self._process.join()


def _work(pipe: Connection, protocol: Protocol, folder: Path, lpips: Path | None) -> None:
    """The worker: tasks in, messages out, until the other end is closed."""
    from .lpips import Perceptual

    network = None if lpips is None else Perceptual(lpips)
    while True:
        try:
            task = pipe.recv()
        except EOFError:
            return
        for message in perform(task, protocol, folder, network):
            pipe.send(message)
        pipe.send(("done",))
