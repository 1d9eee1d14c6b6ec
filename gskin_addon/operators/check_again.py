# SPDX-License-Identifier: GPL-3.0-or-later
"""Check Again: look anew at what the panel remembers of splats, rig and runtime."""

from __future__ import annotations

import bpy

from ..session import learning_runtime, readiness


class GSKIN_OT_check_again(bpy.types.Operator):
    """Look at splats, rig and learning runtime anew, where something changed that the panel did not notice"""

    bl_idname = "gskin.check_again"
    bl_label = "Check Again"
    bl_options = {"INTERNAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        learning_runtime.forget()
        readiness.forget()
        found = [check for check in readiness.checks(context) if check.state != "ok"]
        self.report({"INFO"}, found[0].sentence if found else "All is ready")
        return {"FINISHED"}


CLASSES = (GSKIN_OT_check_again,)
