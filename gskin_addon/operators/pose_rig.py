# SPDX-License-Identifier: GPL-3.0-or-later
"""Pose the Rig: from splats that follow an armature to its bones in Pose Mode, in one click."""

from __future__ import annotations

import bpy

from ..scene.proxy_object import followed_armature
from ..session.chosen import chosen_splats


class GSKIN_OT_pose_rig(bpy.types.Operator):
    """Go to Pose Mode on the armature that moves the splats, with its bones drawn in front of them"""

    bl_idname = "gskin.pose_rig"
    bl_label = "Pose the Rig"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        armature = None if splats is None else followed_armature(splats)
        problem = ""
        if armature is None:
            problem = "Select splats that follow an armature"
        elif armature.mode == "POSE":
            problem = "The rig is in Pose Mode already"
        elif context.view_layer.objects.get(armature.name) != armature or not armature.visible_get():
            problem = f"Armature '{armature.name}' is hidden: show it first"
        if problem:
            cls.poll_message_set(problem)
        return not problem

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        armature = followed_armature(splats)
        active = context.view_layer.objects.active
        if active is not None and active.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        for obj in context.view_layer.objects.selected:
            obj.select_set(False)
        armature.select_set(True)
        context.view_layer.objects.active = armature
        armature.show_in_front = True  # bones lie inside of what they move
        bpy.ops.object.mode_set(mode="POSE")
        return {"FINISHED"}


CLASSES = (GSKIN_OT_pose_rig,)
