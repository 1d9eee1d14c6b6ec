# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences: the interpreter that has torch."""

from __future__ import annotations

import time
from pathlib import Path

import bpy

from ..core.errors import InputError
from ..core.worker.interpreter import PythonChecks, check_python, find_worker_python

ROOT = __package__.rpartition(".")[0]
"""The add-on's own name: `bl_ext.<repository>.gskin_addon` as an extension."""

checks = PythonChecks()

_REMEMBER = 5.0
_found: dict[str, tuple[float, Path | None, str]] = {}


class GSkinPreferences(bpy.types.AddonPreferences):
    bl_idname = ROOT

    python: bpy.props.StringProperty(
        name="Python with torch",
        description="The Python program that computes weights: 3.11 or later with torch, numba and scipy. "
        "Empty: $GSKIN_PYTHON, the active environment, or python3, whichever has torch",
        subtype="FILE_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        row = layout.row(align=True)
        row.prop(self, "python")
        row.operator(GSKIN_OT_check_python.bl_idname, text="Check")
        python, problem = worker_python(context)
        if python is None:
            layout.label(text=problem, icon="ERROR")
            return
        report = checks.known(python)
        if report is not None:
            layout.label(text=report.sentence, icon="CHECKMARK" if report.usable else "ERROR")
            if checks.warming(python):
                layout.label(text="Compiling for the first job, a minute, once; you may go on working", icon="TIME")
        elif checks.asking(python):
            layout.label(text=f"Asking {python} ...", icon="TIME")
        else:
            layout.label(text=f"Will use {python}")


class GSKIN_OT_check_python(bpy.types.Operator):
    bl_idname = "gskin.check_python"
    bl_label = "Check Python"
    bl_description = "Start the interpreter once and see whether it has what the computation needs"
    bl_options = {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        _found.clear()
        python, problem = worker_python(context)
        if python is None:
            self.report({"ERROR"}, problem)
            return {"CANCELLED"}
        checks.ask(python)
        bpy.app.timers.register(lambda: _redraw_until_answered(python), first_interval=0.1)
        return {"FINISHED"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        python, problem = worker_python(context)
        if python is None:
            self.report({"ERROR"}, problem)
            return {"CANCELLED"}
        report = check_python(python)
        self.report({"INFO" if report.usable else "ERROR"}, report.sentence)
        return {"FINISHED"} if report.usable else {"CANCELLED"}


def worker_python(context: bpy.types.Context) -> tuple[Path | None, str]:
    """The interpreter for jobs, or None and what to do. Looks at files only, and seldom: menus ask."""
    addon = context.preferences.addons.get(ROOT)
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


def _redraw_until_answered(python: Path) -> float | None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"PREFERENCES", "VIEW_3D"}:
                area.tag_redraw()
    return 0.2 if checks.asking(python) or checks.warming(python) else None


CLASSES = (GSkinPreferences, GSKIN_OT_check_python)
