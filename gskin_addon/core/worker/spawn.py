# SPDX-License-Identifier: GPL-3.0-or-later
"""Starting a process with pipes, for all that runs beside Blender. Standard library only."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Mapping, Sequence


def spawn(
    command: Sequence[str], environment: Mapping[str, str], *, gentle: bool = False, group: bool = False
) -> subprocess.Popen[bytes]:
    """Start a command; stdin, stdout and stderr are pipes.

    gentle: it runs at low priority, so that a window stays responsive meanwhile. group: it starts others, which are to
    be killed along with it. Raises OSError where it cannot be started.
    """
    flags: int = getattr(subprocess, "CREATE_NO_WINDOW", 0)
    if gentle:
        flags |= getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
    process = subprocess.Popen(
        list(command),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=dict(environment),
        start_new_session=group and os.name == "posix",
        creationflags=flags,
    )
    if gentle and hasattr(os, "setpriority"):
        # What the process starts later inherits this.
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, 10)
    return process
