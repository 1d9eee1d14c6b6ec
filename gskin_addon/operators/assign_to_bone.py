# SPDX-License-Identifier: GPL-3.0-or-later
"""Assign to Bone: selected splats follow one bone alone, with a soft rim where wanted."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.skinning.edits.assign import to_bone
from ..scene.armature import deform_bone_names
from ..scene.bone_frames import armature_of
from ..scene.selecting import body_maker
from ..scene.weight_edits import Change
from ._weight_edit import WeightEdit, bone_column, search_bones


class GSKIN_OT_assign_to_bone(WeightEdit, bpy.types.Operator):
    """Let the selected splats follow one bone alone, as a helmet follows the head. Locked groups stay"""

    bl_idname = "gskin.assign_to_bone"
    bl_label = "Assign to Bone"

    needs_selection = True

    bone: bpy.props.StringProperty(
        name="Bone", description="Left empty: that of the active vertex group", search=search_bones
    )
    rim: bpy.props.FloatProperty(
        name="Soft Rim",
        description="Around the selection the bone's share fades out over this way along the body",
        default=0.0,
        min=0.0,
        soft_max=0.5,
        unit="LENGTH",
    )

    def changes(self, splats: bpy.types.Object, selected: Any) -> Change:
        column = bone_column(splats, self.bone, deform_bone_names(armature_of(splats)))
        rim, graph = self.rim, body_maker(splats) if self.rim > 0 else None
        return lambda weights: to_bone(
            weights, column, selected, rim=rim, graph=None if graph is None else graph()
        )

    def reached(self, splats: bpy.types.Object, selected: Any) -> Any:
        """With a rim also splats around the selection; `to_bone` leaves the others to the bit."""
        return None if self.rim > 0 else selected


CLASSES = (GSKIN_OT_assign_to_bone,)
