# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights from elsewhere: from a file, from vertex groups that are there, from the artist's brush."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy_extras.io_utils import ImportHelper

from ..core.errors import GSkinError
from ..core.rig.weights_file import read_weights_file
from ..scene.binding import bind, check_splats
from ..scene.influences import splats_without_bones
from ..scene.single_user import own_mesh, said_of, sharers
from ..scene.splat_object import splat_count
from ..scene.weights import update_rotation_weights, write_weights
from ..session.chosen import chosen_armature, chosen_splats


class GSKIN_OT_load_weights(bpy.types.Operator, ImportHelper):
    """Bind the splats to the armature with skinning weights from an .npz file"""

    bl_idname = "gskin.load_weights"
    bl_label = "Load Splat Weights (.npz)"
    bl_options = {"REGISTER", "UNDO"}

    filename_ext = ".npz"
    if TYPE_CHECKING:
        filepath: str  # ImportHelper's
    filter_glob: bpy.props.StringProperty(default="*.npz", options={"HIDDEN"})
    max_influences: bpy.props.IntProperty(
        name="Max Influences", description="The most bones that move one splat", default=4, min=1, max=4
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _has_both(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats, armature = chosen_splats(context), chosen_armature(context)
        try:
            result = read_weights_file(Path(self.filepath))
            shared = said_of(splats, sharers(splats))
            write_weights(
                splats,
                armature,
                result.weights,
                result.bones,
                max_influences=self.max_influences,
                confidence=result.confidence,
            )
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        words = f"{len(result.weights):,} splats follow {len(result.bones)} bones of '{armature.name}'"
        self.report({"INFO"}, f"{words}; {shared}" if shared else words)
        return {"FINISHED"}


class GSKIN_OT_bind_to_armature(bpy.types.Operator):
    """Let the splats follow the armature with the vertex groups that they have"""

    bl_idname = "gskin.bind_to_armature"
    bl_label = "Bind Splats to Armature"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _has_both(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats, armature = chosen_splats(context), chosen_armature(context)
        try:
            check_splats(splats)
            shared = said_of(splats, own_mesh(splats))
            bind(splats, armature)
            update_rotation_weights(splats)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        still, total = splats_without_bones(splats), splat_count(splats)
        if shared:
            self.report({"INFO"}, shared)
        if still:
            self.report(
                {"WARNING"},
                f"{still:,} of {total:,} splats have no weights for bones of '{armature.name}' and stay as they are; "
                "paint weights, load them or run Auto-Skin",
            )
        else:
            self.report({"INFO"}, f"{total:,} splats follow '{armature.name}'")
        return {"FINISHED"}


def _has_both(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    if chosen_splats(context) is None:
        operator.poll_message_set("Select a splat object; import one with File > Import > Gaussian Splats")
        return False
    if chosen_armature(context) is None:
        operator.poll_message_set("Select the armature along with the splats")
        return False
    return _not_edited(operator, context)


def _not_edited(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    if chosen_splats(context).mode == "EDIT":
        operator.poll_message_set("Leave Edit Mode (Tab)")
        return False
    return True


CLASSES = (GSKIN_OT_load_weights, GSKIN_OT_bind_to_armature)
