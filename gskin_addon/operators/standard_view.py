# SPDX-License-Identifier: GPL-3.0-or-later
"""Show Colors as Captured: the view transform becomes Standard, since AgX and Filmic change captured colours."""

from __future__ import annotations

import bpy

from ..scene.render import changes_colors, use_standard_view


class GSKIN_OT_standard_view(bpy.types.Operator):
    """Use the view transform Standard, which shows captured colours as they are, in renders and rendered views; it
    applies to the whole scene"""

    bl_idname = "gskin.standard_view"
    bl_label = "Show Colors as Captured"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not changes_colors(context.scene):
            cls.poll_message_set("The scene shows captured colors as they are")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        before = context.scene.view_settings.view_transform
        use_standard_view(context.scene)
        self.report({"INFO"}, f"View transform Standard instead of {before}")
        return {"FINISHED"}


CLASSES = (GSKIN_OT_standard_view,)
