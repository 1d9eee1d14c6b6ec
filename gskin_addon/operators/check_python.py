# SPDX-License-Identifier: GPL-3.0-or-later
"""Ask the chosen interpreter whether it has what a job needs."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..core.worker.interpreter import check_python
from ..session.preferences import checks, forget_found, worker_python


class GSKIN_OT_check_python(bpy.types.Operator):
    bl_idname = "gskin.check_python"
    bl_label = "Check Python"
    bl_description = "Start the interpreter once and see whether it has what the computation needs"
    bl_options = {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        forget_found()
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


def _redraw_until_answered(python: Path) -> float | None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"PREFERENCES", "VIEW_3D"}:
                area.tag_redraw()
    return 0.2 if checks.asking(python) or checks.warming(python) else None


CLASSES = (GSKIN_OT_check_python,)
