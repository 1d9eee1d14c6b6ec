# SPDX-License-Identifier: GPL-3.0-or-later
"""One worker per job folder. Standard library only."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from ..errors import InputError
from ..files import disk_error


@contextlib.contextmanager
def job_lock(path: Path, patience: float = 2.0) -> Iterator[None]:
    """Hold the lock file `path` inside the block.

    The system lets go of it when the process ends in any way, so a killed worker leaves no stale lock.

    Args:
        path: the lock file, made where missing; it names its holder for the message.
        patience: seconds to wait for a worker that is just ending.

    Raises:
        InputError: another worker runs the job. GSkinError: the folder cannot be written.
    """
    try:
        # Never through a link: what lies behind it would be emptied.
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        file = open(descriptor, "r+", encoding="utf-8")  # noqa: SIM115  (held across the yield, closed below)
    except OSError as error:
        raise disk_error(error, path) from error
    try:
        until = time.monotonic() + patience
        while not _try_lock(file):
            if time.monotonic() > until:
                file.seek(1)
                holder = file.read(200).strip() or "another process"
                raise InputError(
                    f"The job in '{path.parent}' is being run by {holder}; wait for it, or stop it first."
                )
            time.sleep(0.05)
        with contextlib.suppress(OSError):  # the name is a courtesy; a full disk is met where it matters
            file.seek(0)
            file.truncate()
            file.write(f" process {os.getpid()} on {socket.gethostname()}\n")
            file.flush()
        yield
    finally:
        with contextlib.suppress(OSError):
            file.close()


if sys.platform == "win32":
    import msvcrt

    def _try_lock(file: IO[str]) -> bool:
        try:
            file.seek(0)  # the first byte is the lock, so that the name behind it stays readable
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def _try_lock(file: IO[str]) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        return True
