# SPDX-License-Identifier: GPL-3.0-or-later
"""Mirror Splat Weights: one side of the body gets the weights of the other."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.skinning.edits.mirror import mirror
from ..scene.armature import read_skeleton
from ..scene.bone_frames import armature_of
from ..scene.splat_object import read_cloud
from ..scene.weight_edits import Change
from ._weight_edit import WeightEdit


class GSKIN_OT_mirror_weights(WeightEdit, bpy.types.Operator):
    """Give one side of the body the weights of the other: bones by name and place, splats by what lies across"""

    bl_idname = "gskin.mirror_weights"
    bl_label = "Mirror Splat Weights"

    source: bpy.props.EnumProperty(
        name="From",
        description="The side that is right already, by the names of its bones",
        items=[
            ("left", "Left to Right", "The right side gets the weights of the left one"),
            ("right", "Right to Left", "The left side gets the weights of the right one"),
        ],
        default="left",
    )
    _alone = 0

    def changes(self, splats: bpy.types.Object, selected: Any) -> Change:
        skeleton, means, source = read_skeleton(armature_of(splats)), read_cloud(splats).means, self.source

        def change(weights: Any) -> Any:
            after, alone = mirror(weights, means, skeleton, source=source, selected=selected)
            self._alone = int(alone.sum())
            return after

        return change

    def words(self) -> str:
        return f"{self._alone:,} have no splats across from them, and stay" if self._alone else ""


CLASSES = (GSKIN_OT_mirror_weights,)
