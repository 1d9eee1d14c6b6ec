# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights from elsewhere: from a file, from vertex groups that are there, from the artist's brush."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy_extras.io_utils import ImportHelper

from ..core.job.skinned_files import read_weights
from ..scene.armature import deform_bone_names
from ..scene.binding import bind, check_splats, iter_prepare
from ..scene.fabric import iter_fabric, lay_under, strongest_of
from ..scene.given_weights import iter_give_weights
from ..scene.influences import splats_without_bones
from ..scene.object_ref import ObjectRef
from ..scene.single_user import own_mesh, said_of, sharers
from ..scene.splat_object import splat_count
from ..scene.steps import Steps, in_thread, part_of
from ..scene.weights import iter_read_weights, update_rotation_weights
from ..session.chosen import chosen_armature, chosen_splats, panel_settings
from ._sliced import Sliced, SlicedClick


class GSKIN_OT_load_weights(Sliced, bpy.types.Operator, ImportHelper):
    """Bind the splats to the armature with skinning weights from an .npz file, or a .txt as RigNet writes it"""

    bl_idname = "gskin.load_weights"
    bl_label = "Load Splat Weights"
    bl_options = {"REGISTER", "UNDO"}

    filename_ext = ".npz"
    if TYPE_CHECKING:
        filepath: str  # ImportHelper's
    filter_glob: bpy.props.StringProperty(default="*.npz;*.txt", options={"HIDDEN"})
    max_influences: bpy.props.IntProperty(
        name="Max Influences", description="The most bones that move one splat", default=4, min=1, max=4
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _has_both(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.asked = True
        answer: set[str] = set(super().invoke(context, event))
        return answer

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.begin(context)

    def work(self, context: bpy.types.Context) -> Steps[str]:
        """Read, write the weights, lay the fabric; only the last slice changes the scene."""
        splats, armature = chosen_splats(context), chosen_armature(context)
        paintable, name = panel_settings(context).paintable, armature.name
        path, bones = Path(self.filepath), deform_bone_names(armature)
        result = yield from in_thread(lambda: read_weights(path, bones))
        shared = said_of(splats, sharers(splats))
        fabric = None
        if paintable and len(result.weights) == splat_count(splats):
            bone = strongest_of(result.weights, result.bones, armature)
            fabric = yield from part_of(iter_fabric(splats, bone, armature), 0.0, 0.3)
        writing = iter_give_weights(
            splats,
            armature,
            result.weights,
            result.bones,
            max_influences=self.max_influences,
            confidence=result.confidence,
        )
        stayed = yield from part_of(writing, 0.3, 1.0)
        if fabric is not None:
            lay_under(splats, fabric)
        words = stayed or f"{len(result.weights):,} splats follow {len(result.bones)} bones of '{name}'"
        return f"{words}; {shared}" if shared else words


class GSKIN_OT_bind_to_armature(SlicedClick, bpy.types.Operator):
    """Let the splats follow the armature with the vertex groups that they have"""

    bl_idname = "gskin.bind_to_armature"
    bl_label = "Bind Splats to Armature"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _has_both(cls, context)

    def work(self, context: bpy.types.Context) -> Steps[str]:
        """Make the fabric, then bind, in the last slice."""
        splats, armature = chosen_splats(context), chosen_armature(context)
        check_splats(splats)
        name, bones, ref = armature.name, deform_bone_names(armature), ObjectRef(splats)
        fabric = None
        if panel_settings(context).paintable:
            weights, _ = yield from part_of(iter_read_weights(splats, bones), 0.0, 0.4)
            bone = strongest_of(weights, bones, armature)
            fabric = yield from part_of(iter_fabric(splats, bone, armature), 0.4, 0.9)
            splats = ref.find()
        yield from part_of(iter_prepare(armature), 0.9, 1.0)
        splats = ref.find()
        shared = said_of(splats, own_mesh(splats))
        bind(splats, armature)
        update_rotation_weights(splats)
        if fabric is not None:
            lay_under(splats, fabric)
        still, total = splats_without_bones(splats), splat_count(splats)
        if shared:
            self.report({"INFO"}, shared)
        if still:
            self.report(
                {"WARNING"},
                f"{still:,} of {total:,} splats have no weights for bones of '{name}' and stay as they are; "
                "paint weights, load them or run Auto-Skin",
            )
            return ""
        return f"{total:,} splats follow '{name}'"


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
