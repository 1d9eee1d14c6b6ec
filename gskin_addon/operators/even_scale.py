# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the Scale Even: splats and rigs need one positive scale for all three axes."""

from __future__ import annotations

import bpy

from ..core.errors import GSkinError
from ..scene.even_scale import even_scale, has_even_scale
from ..session.chosen import chosen_armature, chosen_splats


class GSKIN_OT_even_scale(bpy.types.Operator):
    """Give splats one positive scale for all axes, and apply the scale of an armature that is scaled unevenly"""

    bl_idname = "gskin.even_scale"
    bl_label = "Make the Scale Even"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set("Go to Object Mode")
            return False
        if not _uneven(context):
            cls.poll_message_set("The chosen splats and armature have an even scale")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        done = []
        for obj in _uneven(context):
            try:
                even_scale(obj)
            except GSkinError as error:
                self.report({"ERROR"}, error.plain)
                return {"CANCELLED"}
            done.append(f"'{obj.name}'")
        self.report({"INFO"}, f"{' and '.join(done)} now has an even scale")
        return {"FINISHED"}


def _uneven(context: bpy.types.Context) -> list[bpy.types.Object]:
    chosen = (chosen_splats(context), chosen_armature(context))
    return [obj for obj in chosen if obj is not None and not has_even_scale(obj)]


CLASSES = (GSKIN_OT_even_scale,)
