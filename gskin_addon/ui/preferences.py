# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences."""

from __future__ import annotations

import bpy

from ..session.preferences import ROOT, checks, worker_python


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
        row.operator("gskin.check_python", text="Check")
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


CLASSES = (GSkinPreferences,)
