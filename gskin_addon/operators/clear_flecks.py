# SPDX-License-Identifier: GPL-3.0-or-later
"""Clear Cycles' Flecks: the scene's Cycles settings with which rays pass splats for certain."""

from __future__ import annotations

import bpy

from ..scene.render import clear_flecks, has_flecks


class GSKIN_OT_clear_flecks(bpy.types.Operator):
    """Let every ray of Cycles pass 64 splats before it may end by lot, which leaves white flecks; takes longer"""

    bl_idname = "gskin.clear_flecks"
    bl_label = "Clear Cycles' Flecks"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_flecks(context.scene)

    def execute(self, context: bpy.types.Context) -> set[str]:
        clear_flecks(context.scene)
        return {"FINISHED"}


CLASSES = (GSKIN_OT_clear_flecks,)
