# SPDX-License-Identifier: GPL-3.0-or-later
"""Follow Neighbours: selected splats take weights from the splats around them."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.skinning.edits.blend import follow_neighbours
from ..scene.selecting import body_maker
from ..scene.weight_edits import Change
from ._weight_edit import WeightEdit


class GSKIN_OT_follow_neighbours(WeightEdit, bpy.types.Operator):
    """Give the selected splats the weights that pass most smoothly between the splats around them"""

    bl_idname = "gskin.follow_neighbours"
    bl_label = "Follow Neighbours"

    needs_selection = True
    _alone = 0

    def changes(self, splats: bpy.types.Object, selected: Any) -> Change:
        graph = body_maker(splats)

        def change(weights: Any) -> Any:
            after, alone = follow_neighbours(weights, graph(), selected)
            self._alone = int(alone.sum())
            return after

        return change

    def words(self) -> str:
        return f"{self._alone:,} have no neighbours that are not selected, and stay" if self._alone else ""


CLASSES = (GSKIN_OT_follow_neighbours,)
