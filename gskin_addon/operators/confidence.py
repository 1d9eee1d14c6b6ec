# SPDX-License-Identifier: GPL-3.0-or-later
"""Select Unsure Splats: where automatic weights are most likely to need a hand."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import GSkinError
from ..scene import names
from ..scene.attributes import read_attribute
from ..scene.cleanup import begin_selecting, show_selected
from ..session.chosen import chosen_splats


class GSKIN_OT_select_unsure_splats(bpy.types.Operator):
    """Select the splats whose automatic weights are the least sure, and show them in Edit Mode"""

    bl_idname = "gskin.select_unsure_splats"
    bl_label = "Select Unsure Splats"
    bl_options = {"REGISTER", "UNDO"}

    worst: bpy.props.FloatProperty(
        name="Least Sure",
        description="This part of the splats is selected, the least sure ones",
        default=5.0,
        min=0.0,
        max=100.0,
        precision=1,
        subtype="PERCENTAGE",
    )
    below: bpy.props.FloatProperty(
        name="And All Below",
        description="Splats less sure than this are selected in any case; 0 for none",
        default=0.0,
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
            confidence = read_attribute(obj.data, names.CONFIDENCE)
            unsure = least(confidence, self.worst / 100) | (confidence < self.below)
            show_selected(context, obj, unsure)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        bound = float(confidence[unsure].max(initial=0.0))
        words = f"{unsure.sum():,} of {len(unsure):,} splats selected"
        self.report({"INFO"}, f"{words}, none surer than {bound:.0%}" if unsure.any() else words)
        return {"FINISHED"}


def least(values: NDArray[Any], share: float) -> NDArray[np.bool_]:
    """Mask (N,) of the smallest of values (N,), `share` (0 to 1) of them; of equal ones the first."""
    mask = np.zeros(len(values), bool)
    mask[np.argsort(values, kind="stable")[: round(share * len(values))]] = True
    return mask


CLASSES = (GSKIN_OT_select_unsure_splats,)
