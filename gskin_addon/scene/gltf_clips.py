# SPDX-License-Identifier: GPL-3.0-or-later
"""Which clips go into a glTF file with an armature: its own, played together with what moves it, and no other's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import bpy
import mathutils

from .actions import Part, assign, belongs, is_own, own_parts, parts_of
from .dependencies import is_animated, needed_objects

_companions: dict[bpy.types.Object, list[bpy.types.Object]] = {}
"""While `export_glb` runs: what moves each of its armatures, besides itself."""


@contextmanager
def clips_of(armatures: Sequence[bpy.types.Object], *, posed: bool, animations: bool) -> Iterator[dict[str, Any]]:
    """Options of Blender's exporter for these armatures; inside the block they are in Pose Position.

    posed: the joints shall stand as the bones do now. They do in any case where there are no clips. What moves an
    armature without clips of its own is sampled over the scene's frames.
    """
    positions = [(armature.data, armature.data.pose_position) for armature in armatures]
    stand_in: bpy.types.Action | None = None
    own = {armature: own_parts(armature) for armature in armatures}
    moved = {armature: [obj for obj in needed_objects(armature) if obj != armature] for armature in armatures}
    kept = [_Kept(obj) for obj in dict.fromkeys(obj for objects in moved.values() for obj in objects)]
    poses = [(bone, bone.matrix_basis.copy()) for armature in armatures for bone in armature.pose.bones]
    bake = animations and any(not own[armature] and is_animated([armature, *moved[armature]]) for armature in armatures)
    try:
        for armature in armatures:
            armature.data.pose_position = "POSE"
            if own[armature] and armature.animation_data is None:
                armature.animation_data_create()  # without it the exporter gives it no clips
        if bake and not bpy.data.actions:
            stand_in = bpy.data.actions.new("GSkin Export")  # without any the exporter samples nothing
        _companions.update(moved)
        bpy.context.view_layer.update()
        no_clips = not animations or not (bake or any(own.values()))
        stands = posed or no_clips
        # At frame 0, where the exporter goes otherwise, what is animated stands elsewhere.
        yield {
            "export_rest_position_armature": not stands,
            "export_current_frame": stands,
            "export_bake_animation": bake,
        }
    finally:
        _companions.clear()
        for data, position in positions:
            data.pose_position = position
        for bone, matrix in poses:
            bone.matrix_basis = matrix  # the exporter puts bones to rest before a clip, and leaves them there
        for each in kept:
            each.put_back()
        if stand_in is not None:
            bpy.data.actions.remove(stand_in)


def keep_own(obj: bpy.types.Object, gathered: Any) -> None:
    """Take the parts of others' actions out of what Blender's exporter has gathered for an armature."""
    if isinstance(gathered.actions if hasattr(gathered, "actions") else None, dict):
        for action_key, datas in list(gathered.actions.items()):
            for data in datas:
                data.slots = [slot for slot in data.slots if is_own(Part(data.action, slot.slot), obj)]
            left = [data for data in datas if data.slots]
            if not left:
                del gathered.actions[action_key]
                continue
            gathered.actions[action_key] = left
            if len(left) == 1:
                left[0].name = left[0].action.name  # it was told from others' clips of the same action
    else:  # before Blender 4.4
        gathered.blender_actions = [action for action in gathered.blender_actions if is_own(Part(action), obj)]


def rest_before_clips(obj: bpy.types.Object) -> None:
    """Before the clips of an armature are sampled: bones that a clip does not key are at rest in it.

    The exporter sees to that itself, but not for the action that is active already.
    """
    if obj in _companions:
        for bone in obj.pose.bones:
            bone.matrix_basis = mathutils.Matrix()


def play_companions(obj: bpy.types.Object, action: bpy.types.Action) -> None:
    """Before a clip of an armature is sampled: what moves it plays its own part of the same action."""
    for other in _companions.get(obj, ()):
        own = [part for part in parts_of(action) if part.slot is not None and belongs(part, other)]
        if len(own) == 1:
            assign(other, own[0])


class _Kept:
    """An object's action and place, and those of its bones, to be put back after clips were played."""

    def __init__(self, obj: bpy.types.Object) -> None:
        self._obj, self._part = obj, _assigned(obj)
        bones = obj.pose.bones if obj.pose is not None else ()
        self._places = [(each, each.matrix_basis.copy()) for each in (obj, *bones)]

    def put_back(self) -> None:
        if _assigned(self._obj) == self._part:
            return
        if self._part is not None:
            assign(self._obj, self._part)
        else:
            data: Any = self._obj.animation_data
            data.action = None
        for each, place in self._places:
            each.matrix_basis = place


def _assigned(obj: bpy.types.Object) -> Part | None:
    data: Any = obj.animation_data
    if data is None or data.action is None:
        return None
    return Part(data.action, getattr(data, "action_slot", None))
