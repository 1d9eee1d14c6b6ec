# SPDX-License-Identifier: GPL-3.0-or-later
"""Posing an armature from a script, and the splats as they are in the present pose."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import bpy
import mathutils
import numpy as np

from ..core.errors import InputError
from ..core.rig.lbs import skin_cloud, stretch_rows
from ..core.rig.stretch import polar
from ..core.splats.cloud import SplatCloud
from .anchored import proxy_of
from .armature import bends_of, pose_transforms_of
from .bone_frames import armature_of
from .controls import controls, find_control, outer_sources, why_held
from .deform_stack import beyond_linear_blending, measured_deform
from .proxy_object import posed_anchored
from .splat_object import read_cloud, to_world
from .visibility import shown
from .weights import read_weights

_CHANNELS = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}
"""The rotation that counts, by rotation mode; Euler angles for all others."""

_SAME = 0.002
"""Radians that two rotations may differ by and still be one."""


def turn_bones(
    armature: bpy.types.Object, turns: Mapping[str, Sequence[float]], frame: int | None = None
) -> list[str]:
    """Turn pose bones on top of their present pose, each about its head; gives sentences about what held some back.

    turns: bone name -> rotation vector (3,) in degrees about the world's axes, as they lie in the rest pose
    (the paper's local joint rotation). The bones keep their rotation modes. With `frame` their rotations are keyed
    there. Raises InputError for an unknown bone, and for one that does not turn, with the reason and what to turn
    instead; no bone is turned then.
    """
    for name in turns:
        if name not in armature.pose.bones:
            raise InputError(
                f"Armature '{armature.name}' has no bone '{name}'; its bones are listed in Edit Mode."
            )
    with shown([armature]):
        bpy.context.view_layer.update()
        before = channels(armature, turns)
        for name, vector in turns.items():
            turn_bone(armature, name, vector)
        asked = {name: armature.pose.bones[name].matrix_basis.copy() for name in turns}
        notes = [] if all_free(armature, asked) else _one_by_one(armature, turns, before)
    if frame is not None:
        for name in turns:
            bone = armature.pose.bones[name]
            bone.keyframe_insert(rotation_channel(bone), frame=frame, group=name)
    return notes


def hold_pose(armature: bpy.types.Object) -> list[str]:
    """Let the present pose stay when the frame changes: the action is taken off, NLA tracks are muted.

    Both stay in the file. Gives sentences about it.
    """
    data: Any = armature.animation_data
    if data is None:
        return []
    notes = []
    data.use_tweak_mode = False
    if data.action is not None:
        data.action.use_fake_user = True
        notes.append(f"the action '{data.action.name}' of '{armature.name}' was taken off, so that the pose stays")
        data.action = None
    playing = [track for track in data.nla_tracks if not track.mute]
    for track in playing:
        track.mute, track.is_solo = True, False
    if playing:
        names = ", ".join(f"'{track.name}'" for track in playing)
        notes.append(f"NLA tracks of '{armature.name}' were muted, so that the pose stays: {names}")
    return notes


Channels = Mapping[str, tuple[float, ...]]
"""Rotations of pose bones, each as its rotation mode keeps them, by bone."""


def channels(armature: bpy.types.Object, names: Iterable[str] | None = None) -> Channels:
    """Rotations of the named pose bones (default: of all) to come back to with `restore`."""
    bones = armature.pose.bones
    return {
        name: tuple(getattr(bones[name], rotation_channel(bones[name])))
        for name in (bones.keys() if names is None else names)
    }


def restore(armature: bpy.types.Object, before: Channels, *, update: bool = True) -> None:
    """Set what `channels` took; the rig is evaluated anew unless it will be anyway."""
    for name, values in before.items():
        bone = armature.pose.bones[name]
        setattr(bone, rotation_channel(bone), values)
    if update:
        bpy.context.view_layer.update()


def pose_matrices(armature: bpy.types.Object) -> dict[str, mathutils.Matrix]:
    """Evaluated matrices of all pose bones in the armature's space, by name."""
    with shown([armature]):
        evaluated = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
        return {bone.name: bone.matrix.copy() for bone in evaluated.pose.bones}


def posed_cloud(obj: bpy.types.Object) -> SplatCloud:
    """The splats of `obj` in world space as its armature, or the mesh they hang on, poses them now.

    At rest where they follow neither.
    """
    if proxy_of(obj) is not None:
        return posed_anchored(obj)
    cloud = read_cloud(obj)
    armature = armature_of(obj)
    if armature is None:
        return cloud
    if beyond_linear_blending(obj):
        return _measured_cloud(obj)
    weights, _ = read_weights(obj)
    transforms = pose_transforms_of(armature)
    total = weights.sum(axis=1, keepdims=True)
    # A splat without weights stays where it is: one more "bone" that never moves takes it.
    weights = np.concatenate([weights / np.maximum(total, 1e-12), total <= 0], axis=1).astype(np.float32)
    return skin_cloud(cloud, weights, np.concatenate([transforms, np.eye(4)[None]]), bends=bends_of(armature))


def _measured_cloud(obj: bpy.types.Object) -> SplatCloud:
    """The splats in world space as whatever modifiers of `obj` put, turn and stretch them, by finite differences."""
    rest = read_cloud(obj, world=False)
    moved, maps = measured_deform(obj)
    turn, _, parity = polar(maps)
    posed = dataclasses.replace(rest, means=moved)
    everything = np.arange(rest.count)
    return to_world(stretch_rows(posed, rest, everything, turn, maps, parity < 0), obj)


def rotation_channel(bone: bpy.types.PoseBone) -> str:
    """The property in which a bone keeps its rotation."""
    return _CHANNELS.get(bone.rotation_mode, "rotation_euler")


def _rotation(bone: bpy.types.PoseBone) -> mathutils.Quaternion:
    if bone.rotation_mode == "QUATERNION":
        return bone.rotation_quaternion.normalized()
    if bone.rotation_mode == "AXIS_ANGLE":
        angle, *axis = bone.rotation_axis_angle
        return mathutils.Quaternion(axis, angle)
    return bone.rotation_euler.to_quaternion()


def turn_bone(armature: bpy.types.Object, name: str, vector: Sequence[float]) -> None:
    """Turn one bone as `turn_bones` does, whatever comes of it."""
    bone = armature.pose.bones[name]
    world = armature.matrix_world.to_quaternion()
    rest = world @ bone.bone.matrix_local.to_quaternion()
    rotation = rest.inverted() @ _quaternion(vector) @ rest @ _rotation(bone)
    if bone.rotation_mode == "QUATERNION":
        bone.rotation_quaternion = rotation
    elif bone.rotation_mode == "AXIS_ANGLE":
        axis, angle = rotation.to_axis_angle()
        bone.rotation_axis_angle = (angle, *axis)
    else:
        mode: Any = bone.rotation_mode
        bone.rotation_euler = rotation.to_euler(mode, bone.rotation_euler)


def _quaternion(vector: Sequence[float]) -> mathutils.Quaternion:
    angles = mathutils.Vector([float(np.radians(angle)) for angle in vector])
    return mathutils.Quaternion(angles.normalized(), angles.length) if angles.length else mathutils.Quaternion()


def _angle(rotation: mathutils.Quaternion) -> float:
    """The shorter way of a rotation, 0 to pi."""
    return float(min(rotation.angle, 2 * np.pi - rotation.angle))


def all_free(armature: bpy.types.Object, asked: Mapping[str, mathutils.Matrix]) -> bool:
    """Whether these bones are evaluated as asked, by their own matrices; not so where others have a say.

    asked: taken before the evaluation, which lets drivers write over the channels.
    """
    bpy.context.view_layer.update()
    evaluated = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
    for name, basis in asked.items():
        now = evaluated.pose.bones[name]
        parents: dict[str, Any] = {}
        if now.parent is not None:
            parents = {"parent_matrix": now.parent.matrix, "parent_matrix_local": now.parent.bone.matrix_local}
        free = now.bone.convert_local_to_pose(basis, now.bone.matrix_local, **parents)
        if _angle(free.to_quaternion().rotation_difference(now.matrix.to_quaternion())) > _SAME:
            return False
    return True


def _one_by_one(
    armature: bpy.types.Object, turns: Mapping[str, Sequence[float]], before: Channels
) -> list[str]:
    """Turn the bones after each other and look at each before and after."""
    restore(armature, before)
    notes = []
    for name, vector in turns.items():
        asked = _angle(_quaternion(vector))
        last = pose_matrices(armature)[name].to_quaternion()
        turn_bone(armature, name, vector)
        bpy.context.view_layer.update()
        got = _angle(last.rotation_difference(pose_matrices(armature)[name].to_quaternion()))
        if asked > _SAME and got < max(_SAME, 0.02 * asked):
            restore(armature, before)
            raise InputError(_held(armature, name, vector, before))
        if abs(asked - got) > max(_SAME, 0.02 * asked):
            words = f"'{name}' turned by {np.degrees(got):.0f} of {np.degrees(asked):.0f} degrees"
            reason = why_held(armature, name)
            notes.append(f"{words}: its rotation {reason}" if reason else words)
    return notes


def _held(
    armature: bpy.types.Object, name: str, vector: Sequence[float], before: Channels
) -> str:
    """Why a bone does not turn, and what to turn instead."""
    if armature.data.pose_position == "REST":
        return f"Armature '{armature.name}' is in Rest Position, in which no bone turns; set it to Pose Position."
    every = channels(armature)
    control = find_control(
        armature, name, lambda other: turn_bone(armature, other, vector), lambda: restore(armature, every)
    )
    restore(armature, before)
    reason = why_held(armature, name) or "does not follow its channels"
    words = f"Bone '{name}' of '{armature.name}' cannot be turned, because its rotation {reason}"
    if control is not None:
        return f"{words}; {control}."
    found = ", ".join(f"'{other}'" for other in [*outer_sources(armature, name), *controls(armature, name)[:3]])
    return f"{words}; move or change what it follows instead: {found}." if found else f"{words}."
