# SPDX-License-Identifier: GPL-3.0-or-later
"""Separate Selection: a seam between the selected splats and what they touch without belonging to it."""

from __future__ import annotations

import bpy
import numpy as np

from ..core.errors import GSkinError, InputError
from ..core.skinning.edits.separate import separate
from ..scene import names
from ..scene.armature import read_skeleton
from ..scene.bone_frames import armature_of
from ..scene.cleanup import begin_selecting, show_selected
from ..scene.seams import read_seams, write_seams
from ..scene.splat_object import read_cloud
from ..scene.weight_edits import selected_splats
from ..scene.weights import read_weights
from ..session.chosen import chosen_splats
from ._weight_edit import WeightEdit, bone_column, search_bones


class GSKIN_OT_separate_parts(bpy.types.Operator):
    """Mark the selected splats as a part that only touches what is around it, as a helmet in a hand touches the thigh:
    Auto-Skin, Smooth and the other tools then do not go from one to the other. What holds it is left open"""

    bl_idname = "gskin.separate_parts"
    bl_label = "Separate Selection"
    bl_options = {"REGISTER", "UNDO"}

    bone: bpy.props.StringProperty(
        name="Belongs to",
        description="The bone that the selection is to follow; left empty: the one that most of it follows now",
        search=search_bones,
    )
    reach: bpy.props.FloatProperty(
        name="Reach",
        description="How far from the selection the other side of the seam goes",
        default=0.05,
        min=0.0,
        soft_max=0.5,
        unit="LENGTH",
    )

    poll = WeightEdit.poll

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        mode = splats.mode
        try:
            selected = selected_splats(splats)
            if not selected.any():
                raise InputError(f"No splats of '{splats.name}' are selected; select one side of the seam.")
            begin_selecting(context, splats)
            skeleton = read_skeleton(armature_of(splats))
            bones = list(skeleton.names)
            labels = separate(
                read_cloud(splats).means,
                read_weights(splats, bones)[0],
                skeleton,
                selected,
                self.reach,
                bone=bone_column(splats, self.bone, bones) if self.bone else None,
                sides=read_seams(splats),
            )
            write_seams(splats, labels)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        finally:
            if mode != splats.mode:
                bpy.ops.object.mode_set(mode=mode)
        other = int((labels == labels.max()).sum())
        self.report(
            {"INFO"},
            f"{selected.sum():,} splats are apart from {other:,} that they touch; run Auto-Skin, or Refine Selected",
        )
        return {"FINISHED"}


class GSKIN_OT_select_seams(bpy.types.Operator):
    """Select the splats on both sides of all seams, and show them in Edit Mode"""

    bl_idname = "gskin.select_seams"
    bl_label = "Select Seams"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _has_seams(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        begin_selecting(context, splats)
        labels = read_seams(splats)
        marked = np.zeros(len(splats.data.vertices), np.bool_) if labels is None else labels != 0
        show_selected(context, splats, marked)
        self.report({"INFO"}, f"{marked.sum():,} splats lie along seams")
        return {"FINISHED"}


class GSKIN_OT_clear_seams(bpy.types.Operator):
    """Take the seams away: of the selected splats in Edit Mode, else all"""

    bl_idname = "gskin.clear_seams"
    bl_label = "Clear Seams"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _has_seams(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        mode, some = splats.mode, selected_splats(splats)
        begin_selecting(context, splats)
        labels = read_seams(splats)
        if labels is not None:
            cleared = some if mode == "EDIT" else np.ones(len(labels), np.bool_)
            write_seams(splats, np.where(cleared, 0, labels))
        if mode != splats.mode:
            bpy.ops.object.mode_set(mode=mode)
        return {"FINISHED"}


def _has_seams(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    splats = chosen_splats(context)
    if splats is None or names.SIDE not in splats.data.attributes:
        operator.poll_message_set("There are no seams; make one with Separate Selection")
        return False
    return True


CLASSES = (GSKIN_OT_separate_parts, GSKIN_OT_select_seams, GSKIN_OT_clear_seams)
