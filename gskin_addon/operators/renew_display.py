# SPDX-License-Identifier: GPL-3.0-or-later
"""Renew Display: splats of a file that an older version made get the present display."""

from __future__ import annotations

import bpy

from ..scene.bone_frames import armature_modifier
from ..scene.display_inputs import BY_SHADER
from ..scene.node_builder import has_input
from ..scene.node_groups import find_display, renew_display
from ..scene.probes import follow_stack
from ..scene.render import prepare_scene
from ..scene.rotation_nodes import add_rotation, frames_of
from ..session.chosen import chosen_splats


class GSKIN_OT_renew_display(bpy.types.Operator):
    """Give these splats, which an older version of GSkin imported, the present display; its settings stay"""

    bl_idname = "gskin.renew_display"
    bl_label = "Renew Display"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        modifier = None if splats is None or splats.library is not None else find_display(splats)
        return modifier is not None and not has_input(modifier, BY_SHADER)

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        renew_display(splats)
        prepare_scene(context.scene)
        frames, armature = frames_of(splats), armature_modifier(splats)
        if frames is not None and armature is not None:
            add_rotation(splats, frames, armature)  # the present display needs what the present nodes keep
            follow_stack(splats)
        return {"FINISHED"}


CLASSES = (GSKIN_OT_renew_display,)
