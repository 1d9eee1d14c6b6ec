# SPDX-License-Identifier: GPL-3.0-or-later
"""Save Splat Weights: the vertex groups of the splats as the file that Load Splat Weights reads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy_extras.io_utils import ExportHelper

from ..core.errors import GSkinError, InputError
from ..core.rig.weights_file import write_weights_file
from ..scene import names
from ..scene.armature import read_skeleton
from ..scene.attributes import read_attribute
from ..scene.proxy_object import followed_armature
from ..scene.weights import read_weights
from ..session.chosen import chosen_splats


class GSKIN_OT_save_weights(bpy.types.Operator, ExportHelper):
    """Save the splats' weights, with the bones they belong to, as an .npz file that Load Splat Weights reads"""

    bl_idname = "gskin.save_weights"
    bl_label = "Save Splat Weights (.npz)"

    filename_ext = ".npz"
    if TYPE_CHECKING:
        filepath: str  # ExportHelper's
    filter_glob: bpy.props.StringProperty(default="*.npz", options={"HIDDEN"})

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


def save_weights(splats: bpy.types.Object, path: Path) -> tuple[int, int]:
    """Write the normalised weights of splats that follow an armature; the numbers of splats and deform bones.

    Raises InputError: splats without weights, no deform bones, Edit Mode. GSkinError: the file cannot be written.
    """
    armature = followed_armature(splats)
    skeleton = read_skeleton(armature)
    weights, _ = read_weights(splats, skeleton.names)
    total = weights.sum(axis=1, keepdims=True)
    empty = int((total <= 0).sum())
    if empty:
        raise InputError(
            f"{empty:,} of the {len(weights):,} splats of '{splats.name}' have no weights for bones of "
            f"'{armature.name}'; paint some, or run Auto-Skin."
        )
    confidence = read_attribute(splats.data, names.CONFIDENCE)
    write_weights_file(path, weights / total, skeleton, confidence=confidence)
    return len(weights), skeleton.count


CLASSES = (GSKIN_OT_save_weights,)
