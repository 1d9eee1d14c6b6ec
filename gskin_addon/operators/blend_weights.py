# SPDX-License-Identifier: GPL-3.0-or-later
"""Blend Weights: part of the way from the weights that are shown to those that Compare Weights keeps."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.errors import InputError
from ..scene.armature import deform_bone_names
from ..scene.bone_frames import armature_of
from ..scene.compared import compared, kept_side
from ..scene.weight_edits import Change
from ..session.chosen import chosen_splats
from ._weight_edit import WeightEdit


class GSKIN_OT_blend_weights(WeightEdit, bpy.types.Operator):
    """Mix the other side of Compare Weights into the weights that are shown. Locked groups stay"""

    bl_idname = "gskin.blend_weights"
    bl_label = "Blend Weights"

    factor: bpy.props.FloatProperty(
        name="Factor",
        description="How much of the other side: 0 changes nothing, 1 takes it altogether",
        default=0.5,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if compared(chosen_splats(context)) is None:
            cls.poll_message_set("There are no weights to compare with")
            return False
        return True

    def changes(self, splats: bpy.types.Object, selected: Any) -> Change:
        other, factor = kept_side(splats, deform_bone_names(armature_of(splats))), self.factor
        if other is None:
            raise InputError(f"'{splats.name}' has no weights to compare with.")
        return lambda weights: (1 - factor) * weights + factor * other


CLASSES = (GSKIN_OT_blend_weights,)
