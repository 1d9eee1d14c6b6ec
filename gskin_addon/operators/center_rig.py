# SPDX-License-Identifier: GPL-3.0-or-later
"""Move Rig into Splats: a rig that stands elsewhere is brought to where the splats are."""

from __future__ import annotations

import bpy

from ..scene.rig_fit import move_rig, rest_skeleton, sample_splats, step_to_fit
from ..scene.transforms import points_in_world
from ..session.chosen import chosen_armature, chosen_splats
from ._rig_and_splats import can_move_rig


class GSKIN_OT_center_rig(bpy.types.Operator):
    """Move the armature object (or what carries it) into the splats: middle over middle, and feet on feet"""

    bl_idname = "gskin.center_rig"
    bl_label = "Move Rig into Splats"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return can_move_rig(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats, armature = chosen_splats(context), chosen_armature(context)
        context.view_layer.update()
        step = step_to_fit(points_in_world(sample_splats(splats).points, splats), rest_skeleton(armature))
        top = move_rig(armature, step)
        self.report({"INFO"}, f"'{top.name}' was moved into '{splats.name}'")
        return {"FINISHED"}


CLASSES = (GSKIN_OT_center_rig,)
