# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of what happens in time, on machines of any speed, and of interrupts, however the tests were started."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

HANG = 120.0
"""Seconds after which something hangs. Far beyond what anything takes: how fast things are is for the benchmarks."""


def wait_until(condition: Callable[[], Any], what: str = "it does not happen") -> None:
    """Return once `condition()` is true; AssertionError with `what` after HANG seconds."""
    until = time.monotonic() + HANG
    while not condition():
        assert time.monotonic() < until, what
        time.sleep(0.01)


def interruptible(command: list[Any], **options: Any) -> subprocess.Popen[Any]:
    """A process that SIGINT reaches, which a shell's `command &` and many a CI runner tell their children to ignore."""
    with interrupts():
        return subprocess.Popen(command, **options)


@contextmanager
def interrupts() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt inside the block, and children that start in it have the default of it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
