# SPDX-License-Identifier: GPL-3.0-or-later
"""Make Riggable: splats that Blender imported itself become a splat object that an armature can move."""

from __future__ import annotations

import bpy

from ..core.errors import GSkinError
from ..scene.blender_splats import is_blender_splats, make_riggable
from ..scene.splat_object import splat_count
from ..session import readiness
from ..session.chosen import chosen_blender_splats


class GSKIN_OT_make_riggable(bpy.types.Operator):
    """Turn Blender's own Gaussian splats into a mesh of the same splats, which an armature can move and Weight Paint
    can paint. The object keeps its name, place and attributes; undo brings the point cloud back"""

    bl_idname = "gskin.make_riggable"
    bl_label = "Make Riggable"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not _chosen(context):
            cls.poll_message_set("Select a splat object that Blender imported (.ply, .spz or .usd)")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        done = 0
        for obj in _chosen(context):
            try:
                made = make_riggable(context, obj)
            except GSkinError as error:
                self.report({"ERROR"}, error.plain)
                continue
            done += 1
            readiness.look_at(made)
            self.report({"INFO"}, f"'{made.name}': {splat_count(made):,} splats can follow an armature now")
        return {"FINISHED"} if done else {"CANCELLED"}


def _chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
    """All selected splat objects of Blender's, or the one that the panel's choices stand for."""
    found = [obj for obj in context.selected_objects if is_blender_splats(obj)]
    chosen = chosen_blender_splats(context)
    return found or ([chosen] if chosen is not None else [])


CLASSES = (GSKIN_OT_make_riggable,)
