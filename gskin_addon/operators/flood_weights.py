# SPDX-License-Identifier: GPL-3.0-or-later
"""Flood Splat Weights: one weight of one bone for all selected splats."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.skinning.edits.assign import flood
from ..scene.armature import deform_bone_names
from ..scene.bone_frames import armature_of
from ..scene.weight_edits import Change
from ._weight_edit import WeightEdit, bone_column, search_bones


class GSKIN_OT_flood_weights(WeightEdit, bpy.types.Operator):
    """Give the selected splats one weight of a bone; their other bones share the rest. Locked groups stay"""

    bl_idname = "gskin.flood_weights"
    bl_label = "Flood Splat Weights"

    needs_selection = True

    bone: bpy.props.StringProperty(
        name="Bone", description="Left empty: that of the active vertex group", search=search_bones
    )
    weight: bpy.props.FloatProperty(
        name="Weight", description="Of this bone", default=1.0, min=0.0, max=1.0, subtype="FACTOR"
    )

    def changes(self, splats: bpy.types.Object, selected: Any) -> Change:
        column, weight = bone_column(splats, self.bone, deform_bone_names(armature_of(splats))), self.weight
        return lambda weights: flood(weights, column, weight, selected)


CLASSES = (GSKIN_OT_flood_weights,)
