# SPDX-License-Identifier: GPL-3.0-or-later
"""What the add-on's preferences say: the interpreter that has torch."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import InputError
from ..core.worker import own_python
from ..core.worker.interpreter import PythonChecks, find_worker_python

ROOT = __package__.rpartition(".")[0]
"""The add-on's own name: `bl_ext.<repository>.gskin_addon` as an extension."""

checks = PythonChecks()

_REMEMBER = 5.0
_found: dict[str, tuple[float, Path | None, str]] = {}


def worker_python(context: bpy.types.Context) -> tuple[Path | None, str]:
    """The interpreter for jobs, or None and what to do. Looks at files only, and seldom: menus ask."""
    addon: Any = context.preferences.addons.get(ROOT)
    preference = addon.preferences.python if addon is not None and addon.preferences is not None else ""
    now = time.monotonic()
    known = _found.get(preference)
    if known is None or now - known[0] > _REMEMBER:
        try:
            path, problem = find_worker_python(bpy.path.abspath(preference)), ""
        except InputError as error:
            path, problem = None, str(error)
        if path is None and not problem:
            problem = "No Python with torch was found: name one in the add-on's preferences (or GSKIN_PYTHON)"
        known = _found[preference] = (now, path, problem)
    return known[1], known[2]


def job_python(context: bpy.types.Context, needs_runtime: bool) -> tuple[Path | None, str]:
    """The interpreter for a job, or None and what to do: Blender's own for jobs that need numpy only."""
    if needs_runtime:
        return worker_python(context)
    try:
        return own_python.job_python(False), ""
    except InputError as error:
        return None, str(error)


def forget_found() -> None:
    """Look for the interpreter anew at the next question."""
    _found.clear()
