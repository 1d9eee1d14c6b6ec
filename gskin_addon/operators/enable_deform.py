# SPDX-License-Identifier: GPL-3.0-or-later
"""Let All Bones Deform: an armature whose bones move nothing gets bones that do."""

from __future__ import annotations

import bpy

from ..session.chosen import chosen_armature


class GSKIN_OT_enable_deform(bpy.types.Operator):
    """Turn on Deform for all bones of the armature, so that splats can follow them"""

    bl_idname = "gskin.enable_deform"
    bl_label = "Let All Bones Deform"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        armature = chosen_armature(context)
        if armature is None or not armature.data.bones:
            cls.poll_message_set("Choose an armature with bones")
            return False
        if armature.mode == "EDIT":
            cls.poll_message_set("Leave Edit Mode (Tab)")
            return False
        if armature.data.library is not None:
            cls.poll_message_set("The armature is linked from another file; change it there")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        armature = chosen_armature(context)
        off = [bone for bone in armature.data.bones if not bone.use_deform]
        for bone in off:
            bone.use_deform = True
        self.report({"INFO"}, f"{len(off)} bones of '{armature.name}' move splats from now on")
        return {"FINISHED"}


CLASSES = (GSKIN_OT_enable_deform,)
