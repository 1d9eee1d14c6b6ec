# SPDX-License-Identifier: GPL-3.0-or-later
"""Select Unsure Splats: where automatic weights are most likely to need a hand."""

from __future__ import annotations

import bpy

from ..core.errors import GSkinError
from ..scene import names
from ..scene.attributes import read_attribute
from ..scene.cleanup import begin_selecting, show_selected
from ..session.chosen import chosen_splats
from ..session.confidence import SURE


class GSKIN_OT_select_unsure_splats(bpy.types.Operator):
    """Select the splats whose automatic weights are the least sure, and show them in Edit Mode"""

    bl_idname = "gskin.select_unsure_splats"
    bl_label = "Select Unsure Splats"
    bl_options = {"REGISTER", "UNDO"}

    below: bpy.props.FloatProperty(
        name="Confidence Below",
        description="Splats less sure than this are selected",
        default=SURE,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or names.CONFIDENCE not in splats.data.attributes:
            cls.poll_message_set("Select splats with weights from Auto-Skin that know how sure they are")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        obj = chosen_splats(context)
        try:
            begin_selecting(context, obj)
            unsure = read_attribute(obj.data, names.CONFIDENCE) < self.below
            show_selected(context, obj, unsure)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        self.report({"INFO"}, f"{unsure.sum():,} of {len(unsure):,} splats are less sure than {self.below:.2f}")
        return {"FINISHED"}


CLASSES = (GSKIN_OT_select_unsure_splats,)
