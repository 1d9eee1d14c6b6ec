# SPDX-License-Identifier: GPL-3.0-or-later
"""Sharpen Splat Weights: the strongest bone of each splat made stronger."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.skinning.edits.blend import sharpen
from ..scene.weight_edits import Change
from ._weight_edit import WeightEdit


class GSKIN_OT_sharpen_weights(WeightEdit, bpy.types.Operator):
    """Make the strongest bones of the splats stronger, so that joints bend more sharply. Locked groups stay"""

    bl_idname = "gskin.sharpen_weights"
    bl_label = "Sharpen Splat Weights"

    amount: bpy.props.FloatProperty(
        name="Amount",
        description="0 changes nothing, 1 leaves each splat its strongest bone alone",
        default=0.5,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )

    def changes(self, splats: bpy.types.Object, selected: Any) -> Change:
        amount = self.amount
        return lambda weights: sharpen(weights, amount)


CLASSES = (GSKIN_OT_sharpen_weights,)
