# SPDX-License-Identifier: GPL-3.0-or-later
"""Save Splat Weights: the vertex groups of the splats as the file that Load Splat Weights reads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy_extras.io_utils import ExportHelper

from ..core.errors import GSkinError
from ..scene.proxy_object import followed_armature
from ..scene.save_weights import save_weights
from ..session.chosen import chosen_splats


class GSKIN_OT_save_weights(bpy.types.Operator, ExportHelper):
    """Save the splats' weights, with the bones they belong to, as a file that Load Splat Weights reads"""

    bl_idname = "gskin.save_weights"
    bl_label = "Save Splat Weights"

    if TYPE_CHECKING:
        filepath: str  # ExportHelper's
    filter_glob: bpy.props.StringProperty(default="*.npz;*.txt", options={"HIDDEN"})
    kind: bpy.props.EnumProperty(
        name="Format",
        items=(
            ("NPZ", "Arrays (.npz)", "All that Load Splat Weights needs, with the confidence"),
            ("RIGNET", "RigNet (.txt)", "A text of joints and weights, as RigNet and other rigging programs have it"),
        ),
        default="NPZ",
    )

    @property
    def filename_ext(self) -> str:
        """What ExportHelper lets the name end in."""
        return ".txt" if self.kind == "RIGNET" else ".npz"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or followed_armature(splats) is None:
            cls.poll_message_set("Select splats that follow an armature")
            return False
        if splats.mode == "EDIT":
            cls.poll_message_set("Leave Edit Mode (Tab)")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        try:
            count, bones = save_weights(splats, Path(self.filepath))
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        self.report({"INFO"}, f"Weights of {count:,} splats for {bones} bones were saved")
        return {"FINISHED"}


CLASSES = (GSKIN_OT_save_weights,)
