# SPDX-License-Identifier: GPL-3.0-or-later
"""Scale Rig to Splats: a rig in centimetres, say, gets the size of the splats."""

from __future__ import annotations

import bpy

from ..scene.rig_fit import guess_rig_scale, sample_splats, scale_rig
from ..scene.transforms import points_in_world
from ..session.chosen import chosen_armature, chosen_splats
from ._rig_and_splats import can_move_rig


class GSKIN_OT_fix_rig_scale(bpy.types.Operator):
    """Scale the armature object (or what carries it) so that its bones are as large as the splats"""

    bl_idname = "gskin.fix_rig_scale"
    bl_label = "Scale Rig to Splats"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return can_move_rig(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats, armature = chosen_splats(context), chosen_armature(context)
        context.view_layer.update()
        guess = guess_rig_scale(points_in_world(sample_splats(splats).points, splats), armature)
        top = scale_rig(armature, guess.factor, about_world=guess.about_world)
        self.report({"INFO"}, f"'{top.name}' was scaled by {guess.factor:.3g}")
        return {"FINISHED"}


CLASSES = (GSKIN_OT_fix_rig_scale,)
