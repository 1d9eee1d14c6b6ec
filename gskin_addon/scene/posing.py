# SPDX-License-Identifier: GPL-3.0-or-later
"""Posing an armature from a script, and the splats as they are in the present pose."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

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
from .deform_stack import beyond_linear_blending, measured_deform
from .proxy_object import posed_anchored
from .splat_object import read_cloud, to_world
from .weights import read_weights


def turn_bones(
    armature: bpy.types.Object, turns: Mapping[str, Sequence[float]], frame: int | None = None
) -> None:
    """Turn pose bones on top of their present pose, each about its head.

    turns: bone name -> rotation vector (3,) in degrees about the world's axes, as they lie in the rest pose
    (the paper's local joint rotation). With `frame` the bones' rotations are keyed there. Raises InputError
    for an unknown bone.
    """
    world = armature.matrix_world.to_quaternion()
    for name, vector in turns.items():
        bone: bpy.types.PoseBone | None = armature.pose.bones.get(name)
        if bone is None:
            raise InputError(
                f"Armature '{armature.name}' has no bone '{name}'; its bones are listed in Edit Mode."
            )
        angles = mathutils.Vector([float(np.radians(angle)) for angle in vector])
        turn = (
            mathutils.Quaternion(angles.normalized(), angles.length)
            if angles.length
            else mathutils.Quaternion()
        )
        rest = world @ bone.bone.matrix_local.to_quaternion()
        present = _rotation(bone)
        bone.rotation_mode = "QUATERNION"
        bone.rotation_quaternion = rest.inverted() @ turn @ rest @ present
        if frame is not None:
            bone.keyframe_insert("rotation_quaternion", frame=frame, group=name)


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


def _rotation(bone: bpy.types.PoseBone) -> mathutils.Quaternion:
    if bone.rotation_mode == "QUATERNION":
        return bone.rotation_quaternion.copy()
    if bone.rotation_mode == "AXIS_ANGLE":
        angle, *axis = bone.rotation_axis_angle
        return mathutils.Quaternion(axis, angle)
    return bone.rotation_euler.to_quaternion()
