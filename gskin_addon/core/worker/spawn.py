# SPDX-License-Identifier: GPL-3.0-or-later
"""Starting a Python process with pipes, for all that runs beside Blender. Standard library only."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path


def spawn(
    python: Path, arguments: Sequence[str], environment: Mapping[str, str], *, isolated: bool, gentle: bool
) -> subprocess.Popen[bytes]:
    """Start `python -u` with arguments; stdin, stdout and stderr are pipes.

    isolated: it sees nothing of the user's own Python packages and PYTHON... variables. gentle: it runs at low
    priority, so that a window stays responsive meanwhile. Raises OSError where it cannot be started.
    """
    flags: int = getattr(subprocess, "CREATE_NO_WINDOW", 0)
    if gentle:
        flags |= getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
    process = subprocess.Popen(
        [str(python), *(["-I"] if isolated else []), "-u", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=dict(environment),
        creationflags=flags,
    )
    if gentle and hasattr(os, "setpriority"):
        # What the process starts later inherits this.
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, 10)
    return process
