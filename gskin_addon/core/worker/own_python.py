# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that this program runs in, as an executable: it runs the jobs that need numpy only."""

from __future__ import annotations

import os
import sys
import sysconfig
from pathlib import Path

from ..errors import InputError
from .interpreter import VARIABLE, find_worker_python


def own_python() -> Path | None:
    """The interpreter behind this process: `sys.executable`, which Blender sets to its own Python; where a packaged
    Blender leaves it empty or names itself, the one in the folders that Python says it lives in."""
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    prefixes = dict.fromkeys((sys.prefix, sys.exec_prefix, sys.base_prefix))
    folders = [folder for prefix in prefixes for folder in (os.path.join(prefix, "bin"), prefix)]
    folders.append(sysconfig.get_path("scripts"))
    names = (f"python{version}", "python3", "python", "python.exe")
    places = [sys.executable, getattr(sys, "_base_executable", "")]
    places += [os.path.join(folder, name) for folder in folders for name in names]
    for place in places:
        path = Path(place)
        if place and path.name.lower().startswith("python") and os.access(path, os.X_OK) and path.is_file():
            return path
    return None


def job_python(needs_runtime: bool, preference: str = "") -> Path:
    """The interpreter for a job: this program's own for one that needs numpy only, else one with torch.

    $GSKIN_PYTHON and `preference`, where there is one, are taken for every job.

    Raises:
        InputError: there is none, with the remedy; or $GSKIN_PYTHON or `preference` cannot be run.
    """
    if not needs_runtime and not preference.strip() and not os.environ.get(VARIABLE, "").strip():
        own = own_python()
        if own is not None:
            return own
    python = find_worker_python(preference)
    if python is None:
        if not needs_runtime:
            raise InputError(
                "No Python was found to run the job in; name one in the add-on's preferences.",
                terminal=f"or {VARIABLE}",
            )
        raise InputError(
            "No Python with torch was found, which guidance needs; name one in the add-on's preferences.",
            terminal=f"--python or {VARIABLE}; gskin runtime install makes one",
        )
    return python
