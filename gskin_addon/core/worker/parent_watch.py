# SPDX-License-Identifier: GPL-3.0-or-later
"""How a process notices that its parent is gone. Standard library only."""

from __future__ import annotations

import contextlib
import ctypes
import os
import stat
import sys
import threading
from collections.abc import Callable

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def die_with_parent(signal_number: int) -> None:
    """Ask Linux to send this process `signal_number` when its parent ends; elsewhere nothing happens.

    For the kernel the parent is the *thread* that started us, so start workers from a long-lived thread.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal_number, 0, 0, 0)


def take_stdin() -> int | None:
    """Move a piped standard input to a private descriptor and return it; None when stdin is no pipe.

    A terminal or /dev/null is no lifeline. Descriptor 0 becomes the null device: libraries must not read
    the pipe, and on Windows a thread that waits on the real stdin can block the loading of DLLs.
    """
    try:
        mode = os.fstat(0).st_mode
    except OSError:
        return None
    if not (stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)):
        return None
    lifeline = os.dup(0)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    return lifeline


def on_close(descriptor: int, act: Callable[[], None]) -> threading.Thread:
    """Call `act` from a thread once the other end of `descriptor` is closed; data that arrives is dropped."""

    def watch() -> None:
        with contextlib.suppress(OSError):
            while os.read(descriptor, 4096):
                continue
        act()

    thread = threading.Thread(target=watch, name="gskin-lifeline", daemon=True)
    thread.start()
    return thread
