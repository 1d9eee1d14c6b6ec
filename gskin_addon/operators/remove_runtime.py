# SPDX-License-Identifier: GPL-3.0-or-later
"""Remove the learning runtime from the disk, after a question."""

from __future__ import annotations

import bpy

from ..core.errors import GSkinError
from ..session import learning_runtime
from ..session.preferences import runtime_folder


class GSKIN_OT_remove_runtime(bpy.types.Operator):
    """Delete the learning runtime's folder; pip keeps what it fetched in its own cache"""

    bl_idname = "gskin.remove_runtime"
    bl_label = "Remove the Learning Runtime"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        try:
            learning_runtime.check_idle()
        except GSkinError as error:
            cls.poll_message_set(error.plain)
            return False
        return learning_runtime.status(context).state != "missing"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(  # type: ignore[return-value]
            self, event, message=f"Delete '{runtime_folder(context)}'?", confirm_text="Delete", icon="WARNING"
        )

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            learning_runtime.remove(context)
            return self._finish()
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}

    def _finish(self) -> set[str]:
        """In a window the files go in the background; without one they are waited for. Raises GSkinError."""
        if not bpy.app.background:
            learning_runtime.follow()
            return {"FINISHED"}
        self.report({"INFO"}, learning_runtime.wait_for_removal())
        return {"FINISHED"}


CLASSES = (GSKIN_OT_remove_runtime,)
