# SPDX-License-Identifier: GPL-3.0-or-later
"""Separate Selection: a seam between the selected splats and what they touch without belonging to it."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ..core.errors import GSkinError
from ..core.skinning.edits.keep_apart import keep_apart
from ..core.skinning.edits.separate import separate
from ..scene import names
from ..scene.armature import read_skeleton
from ..scene.bone_frames import armature_of
from ..scene.cleanup import begin_selecting, show_selected
from ..scene.fabric import cut_fabric
from ..scene.object_ref import object_by_uid
from ..scene.seams import read_seams, write_seams
from ..scene.splat_object import read_cloud
from ..scene.steps import Steps
from ..scene.weight_edits import Change, selected_splats
from ..session.chosen import chosen_splats
from ._weight_edit import WeightEdit, bone_column, search_bones


class GSKIN_OT_separate_parts(WeightEdit, bpy.types.Operator):
    """Mark the selected splats as a part that only touches what is around it, as a helmet in a hand touches the thigh:
    neither follows the other's bones any more, and Auto-Skin, Smooth and the other tools do not go from one to the
    other. What holds the part is left open"""

    bl_idname = "gskin.separate_parts"
    bl_label = "Separate Selection"

    needs_selection = True

    bone: bpy.props.StringProperty(
        name="Belongs to",
        description="The bone that the selection is to follow; left empty: the one that most of it follows now",
        search=search_bones,
    )
    reach: bpy.props.FloatProperty(
        name="Reach",
        description="How far from the selection the other side of the seam goes; 0: a twentieth of the body's size",
        default=0.0,
        min=0.0,
        soft_max=0.5,
        unit="LENGTH",
    )
    free: bpy.props.BoolProperty(
        name="Free Both Sides",
        description="Take from each side the weights of the other side's bones at once; off, only mark the seam",
        default=True,
    )

    _labels: Any = None
    _marked = 0

    def changes(self, splats: bpy.types.Object, selected: Any) -> Change:
        skeleton, means, sides = read_skeleton(armature_of(splats)), read_cloud(splats).means, read_seams(splats)
        column = bone_column(splats, self.bone, list(skeleton.names)) if self.bone else None
        self._reached, self._marked = np.zeros(len(means), np.bool_), int(selected.sum())
        reach, free = self.reach, self.free

        def change(weights: Any) -> Any:
            self._labels = separate(means, weights, skeleton, selected, reach, bone=column, sides=sides)
            if not free:
                return weights
            own = {} if column is None else {int(self._labels[selected][0]): column}
            after, self._reached[:] = keep_apart(weights, means, self._labels, skeleton, bones=own)
            return after

        return change

    def reached(self, splats: bpy.types.Object, selected: Any) -> Any:
        """Known when it is done."""
        return self._reached

    def steps(
        self, context: bpy.types.Context, splats: bpy.types.Object, there: bpy.types.Object, selected: Any
    ) -> Steps[int]:
        uid = splats.session_uid
        count = yield from super().steps(context, splats, there, selected)
        changed = object_by_uid(uid)
        if changed is not None:  # as it is: the last slice has just found it
            write_seams(changed, self._labels)
            cut_fabric(changed, self._labels)
        return count

    def done(self, count: int) -> str:
        other = int((self._labels == self._labels.max()).sum())
        return f"{self._marked:,} splats are apart from {other:,} that they touch; weights of {count:,} were freed"


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
        try:
            begin_selecting(context, splats)
            labels = read_seams(splats)
            marked = np.zeros(len(splats.data.vertices), np.bool_) if labels is None else labels != 0
            show_selected(context, splats, marked)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
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
        try:
            begin_selecting(context, splats)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
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
