# SPDX-License-Identifier: GPL-3.0-or-later
"""Smooth Splat Weights: each splat a step towards its neighbours on the body."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.skinning.edits.blend import smooth
from ..scene.selecting import body_maker
from ..scene.weight_edits import Change
from ._weight_edit import WeightEdit


class GSKIN_OT_smooth_weights(WeightEdit, bpy.types.Operator):
    """Make the weights of the splats more like those of their neighbours on the body. Locked groups stay"""

    bl_idname = "gskin.smooth_weights"
    bl_label = "Smooth Splat Weights"

    factor: bpy.props.FloatProperty(
        name="Factor", description="How far towards the neighbours", default=0.5, min=0.0, max=1.0, subtype="FACTOR"
    )
    repeat: bpy.props.IntProperty(name="Iterations", description="How many times", default=5, min=1, max=200)

    def changes(self, splats: bpy.types.Object, selected: Any) -> Change:
        graph, factor, repeat = body_maker(splats), self.factor, self.repeat
        return lambda weights: smooth(weights, graph(), selected=selected, factor=factor, repeat=repeat)


CLASSES = (GSKIN_OT_smooth_weights,)
