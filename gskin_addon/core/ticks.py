# SPDX-License-Identifier: GPL-3.0-or-later
"""How long functions say how far they are, and are stopped: they call a tick, which may raise Cancelled."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from typing import TypeVar

Tick = Callable[[float], None]
"""Takes the part of a function's work that is done, 0 to 1."""

_PAUSE = 0.1
"""Seconds between two ticks while threads work."""

Result = TypeVar("Result")
Steps = Generator[float, None, Result]
"""Work in pieces: yields the share done, 0 to 1, after each, and returns the result."""


def silent(done: float) -> None:
    """A tick for who does not want to know."""


def run_to_end(steps: Steps[Result]) -> Result:
    """Run all pieces at once; gives what the generator returns."""
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            return stop.value


def stretch(tick: Tick, low: float, high: float) -> Tick:
    """The tick of a part of the work, which spans `low` to `high` of the whole."""
    return lambda done: tick(low + (high - low) * done)


def work(tasks: Sequence[Callable[[Tick], Result]], tick: Tick, threads: int) -> list[Result]:
    """Results of the tasks, run side by side in `threads` threads; each takes a tick of its own.

    `tick` is called from this thread only. What it raises, or a task, stops all others at their next tick, and is
    raised here when they have ended.
    """
    done = [0.0] * len(tasks)
    stopped: list[bool] = []

    def note(number: int, part: float) -> None:
        if stopped:
            raise _Stopped
        done[number] = part

    def begin(number: int) -> Result:
        note(number, 0.0)
        result = tasks[number](lambda part: note(number, part))
        done[number] = 1.0
        return result

    with ThreadPoolExecutor(max(1, min(threads, len(tasks))), thread_name_prefix="gskin") as pool:
        futures = [pool.submit(begin, number) for number in range(len(tasks))]
        try:
            waiting = set(futures)
            while waiting:
                finished, waiting = wait(waiting, _PAUSE, return_when=FIRST_EXCEPTION)
                for future in finished:
                    future.result()
                tick(sum(done) / max(len(done), 1))
        except BaseException:
            stopped.append(True)
            raise
    return [future.result() for future in futures]


def cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class _Stopped(Exception):
    """Ends a task whose result nobody waits for."""
