# SPDX-License-Identifier: GPL-3.0-or-later
"""What the add-on's preferences say: the interpreter that has torch, and where the learning runtime lies."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import InputError
from ..core.worker import own_python
from ..core.worker import runtime_folder as folders
from ..core.worker.interpreter import VARIABLE, PythonChecks, find_worker_python

ROOT = __package__.rpartition(".")[0]
"""The add-on's own name: `bl_ext.<repository>.gskin_addon` as an extension."""

checks = PythonChecks()

_REMEMBER = 5.0
_found: dict[str, tuple[float, Path | None, str]] = {}


def addon_preferences(context: bpy.types.Context) -> Any:
    """The add-on's preferences; None where it is registered but no add-on, as in tests and on the command line."""
    addon: Any = context.preferences.addons.get(ROOT)
    return None if addon is None else addon.preferences


def runtime_folder(context: bpy.types.Context) -> Path:
    """Where the learning runtime lies or will lie."""
    preferences = addon_preferences(context)
    named = "" if preferences is None else bpy.path.abspath(preferences.runtime_folder)
    return folders.runtime_folder(named)


def worker_python(context: bpy.types.Context) -> tuple[Path | None, str]:
    """The interpreter for jobs, or None and what to do. Looks at files only, and seldom: menus ask."""
    preferences = addon_preferences(context)
    preference = "" if preferences is None else preferences.python
    now = time.monotonic()
    known = _found.get(preference)
    if known is None or now - known[0] > _REMEMBER:
        named = bpy.path.abspath(preference)
        if not named and preferences is not None and preferences.runtime_folder and not os.environ.get(VARIABLE):
            named = str(folders.ready_python(runtime_folder(context)) or "")
        try:
            path, problem = find_worker_python(named), ""
        except InputError as error:
            path, problem = None, error.plain
        if path is None and not problem:
            problem = (
                "No Python with torch was found: install the learning runtime in the add-on's preferences, "
                "or name a Python there"
            )
        known = _found[preference] = (now, path, problem)
    return known[1], known[2]


def job_python(context: bpy.types.Context, needs_runtime: bool) -> tuple[Path | None, str]:
    """The interpreter for a job, or None and what to do: Blender's own for jobs that need numpy only."""
    if needs_runtime:
        return worker_python(context)
    try:
        return own_python.job_python(False), ""
    except InputError as error:
        return None, error.plain


def forget_found() -> None:
    """Look for the interpreter anew at the next question."""
    _found.clear()
