# SPDX-License-Identifier: GPL-3.0-or-later
"""Work in slices: a generator yields the share done, 0 to 1, after each, and returns the result.

Blender draws and listens only between slices, so each stays well below 0.1 s for some 400,000 splats.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

from ..core.ticks import Result, Steps, run_to_end

__all__ = ["SLICE", "Steps", "in_thread", "part_of", "run_for", "run_to_end", "slices"]

_WAIT = 0.01  # seconds that one slice waits for a thread

SLICE = 10_000
"""The most splats that one slice visits from Python."""


def run_for(steps: Steps[Result], seconds: float) -> float:
    """Run slices until `seconds` have passed, at least one; gives the share done.

    Raises StopIteration when the work is done, with the generator's result as its value, like `next`.
    """
    until = time.monotonic() + seconds
    while True:
        share = next(steps)
        if time.monotonic() >= until:
            return share


def part_of(steps: Steps[Result], first: float, last: float) -> Steps[Result]:
    """The same work as the part from share `first` to share `last` of a larger one."""
    try:
        while True:
            yield first + (last - first) * next(steps)
    except StopIteration as stop:
        return stop.value
    finally:
        steps.close()


def slices(count: int, size: int = SLICE) -> Iterator[slice]:
    """Consecutive slices of at most `size` that cover `count` things."""
    for first in range(0, count, size):
        yield slice(first, min(first + size, count))


def in_thread(function: Callable[[], Result]) -> Steps[Result]:
    """Run the function, which must not touch Blender, beside it; a slice waits a moment. Raises what it raises."""
    result: list[Result] = []
    raised: list[BaseException] = []

    def run() -> None:
        try:
            result.append(function())
        except BaseException as error:  # it is raised where the result is waited for
            raised.append(error)

    thread = threading.Thread(target=run, name="gskin", daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(_WAIT)
        yield 0.0
    if raised:
        raise raised[0]
    return result[0]
