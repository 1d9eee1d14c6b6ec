# SPDX-License-Identifier: GPL-3.0-or-later
"""The ends of a rig's swings as poses of a library: what Try It plays, one bone and one direction at a time, from rest.

A bone that constraints or IK hold does not turn by its own channels; its pose turns the control that an artist would,
and sets the custom property that this needs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import bpy
import mathutils
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError
from ..core.rig.segments import bone_segments
from .armature import pose_transforms_of, read_skeleton
from .controls import Control, near_control, switched, without_followers
from .pose_assets import Pose, present_values
from .posing import all_free, channels, restore, rotation_channel, turn_bone
from .steps import Steps
from .trial import Swing, rig_swings, turn_about
from .visibility import shown

Array = NDArray[Any]

REST = "Rest"
"""The pose that takes all others back."""
TWIST = 0.3
"""Sine between a bone and its axis below which a turn moves nothing to any side."""
_WAYS = (("Left", "Right"), ("Forward", "Back"), ("Up", "Down"))
_TWISTS = ("Twist Clockwise", "Twist Counterclockwise")


@dataclass(frozen=True)
class TestPoses:
    """poses of a rig, and its deform `transforms` (B, 4, 4) in each of them; held: bones for which nothing was found
    that turns them."""

    armature: bpy.types.Object
    poses: list[Pose]
    transforms: list[Array]
    held: list[str]


def iter_test_poses(splats: bpy.types.Object, front: ArrayLike) -> Steps[TestPoses]:
    """The poses, in slices; the rig is in its rest pose meanwhile, and afterwards to the bit what it was.

    front (3,): the side to which the character looks, in the world. Raises InputError as `rig_swings`, and
    where nothing turns any bone.
    """
    armature, swings = rig_swings(splats)
    directions = directions_of(armature, swings, front)
    found, transforms, held = [], [], []
    used: set[str] = set()
    at_rest: dict[tuple[str, int], float] = {}
    with at_rest_pose(armature):
        for number, (name, ranges) in enumerate(directions.items()):
            control = _control_of(armature, name, ranges)
            if control is None:
                held.append(name)
            elif control.bone not in used:
                used.add(control.bone)
                keys = _keys(armature, control)
                at_rest.update(present_values(armature, keys))
                for axis, angle, direction in ranges:
                    with _turned(armature, name, control, axis, angle):
                        words = f"'{control.bone}' turned by {np.degrees(abs(angle)):.0f} degrees from its rest pose"
                        values = present_values(armature, keys)
                        found.append(
                            Pose(f"{control.bone} {direction}", values, ("Test Pose", control.bone, direction), words)
                        )
                        transforms.append(pose_transforms_of(armature))
            yield (number + 1) / len(directions)
        if not found:
            names = ", ".join(f"'{name}'" for name in held[:5])
            raise InputError(
                f"No bone of '{armature.name}' can be turned, nor a control of one: {names}; mute what holds them."
            )
        found.append(Pose(REST, at_rest, ("Test Pose", REST), "All bones of the test poses as they are at rest"))
        transforms.append(pose_transforms_of(armature))
    return TestPoses(armature, found, transforms, held)


def directions_of(
    armature: bpy.types.Object, swings: Iterable[Swing], front: ArrayLike
) -> dict[str, list[tuple[int, float, str]]]:
    """For each bone of the swings its turns: axis (0 to 2), angle in radians, and to where it goes as the character
    sees it; parents before children."""
    skeleton = read_skeleton(armature)
    segments = bone_segments(skeleton)
    ahead = np.asarray(front, np.float64)
    frame = np.stack([np.cross([0.0, 0.0, 1.0], ahead), ahead, [0.0, 0.0, 1.0]])
    world = np.array(armature.matrix_world.to_quaternion().to_matrix())
    ranges: dict[str, dict[int, tuple[float, float]]] = {}
    for swing in swings:
        for name, axis, low, high in swing.bones:
            ranges.setdefault(name, {})[axis] = low, high
    found = {}
    for place, name in enumerate(skeleton.names):
        if name not in ranges:
            continue
        along = (segments.ends - segments.starts)[segments.bone == place].mean(axis=0)
        along /= max(float(np.linalg.norm(along)), 1e-12)
        axes = world @ np.array(armature.data.bones[name].matrix_local.to_3x3())
        ways = {axis: frame @ np.cross(axes[:, axis], along) for axis in ranges[name]}
        words = _names_of(ways)
        turns = [(axis, angle, words[axis][angle > 0]) for axis, ends in ranges[name].items() for angle in ends]
        found[name] = [turn for turn in turns if abs(turn[1]) > 1e-3]
    return {name: turns for name, turns in found.items() if turns}


@contextmanager
def at_rest_pose(armature: bpy.types.Object) -> Iterator[None]:
    """Inside the block the rig is in its rest pose, free to be posed, and nothing follows it."""
    data: Any = armature.data
    position = data.pose_position
    with shown([armature]), without_followers(armature):
        # What was switched off builds the scene anew, and with it animation is evaluated once more: take the pose now.
        bpy.context.view_layer.update()
        before = channels(armature)
        placed = {b.name: (b.location.copy(), b.scale.copy()) for b in armature.pose.bones}
        try:
            data.pose_position = "POSE"
            for bone in armature.pose.bones:
                bone.matrix_basis = mathutils.Matrix()
            bpy.context.view_layer.update()
            yield
        finally:
            data.pose_position = position
    bpy.context.view_layer.update()
    for name, (location, scale) in placed.items():
        armature.pose.bones[name].location, armature.pose.bones[name].scale = location, scale
    restore(armature, before)


def _names_of(ways: dict[int, Array]) -> dict[int, tuple[str, str]]:
    """By axis: to where a bone goes when it is turned about it backwards, and forwards; never twice the same.

    ways: by axis, to where the bone's end starts when it is turned forwards, in parts of left, ahead and up.
    """
    swinging = [axis for axis, way in ways.items() if np.linalg.norm(way) > TWIST]
    best = max(
        permutations(range(3), len(swinging)),
        key=lambda chosen: sum(abs(ways[axis][k]) for axis, k in zip(swinging, chosen, strict=True)),
    )
    found = dict.fromkeys(ways, _TWISTS[::-1])
    for axis, k in zip(swinging, best, strict=True):
        found[axis] = _WAYS[k][::-1] if ways[axis][k] > 0 else _WAYS[k]
    return found


def _control_of(
    armature: bpy.types.Object, name: str, turns: list[tuple[int, float, str]]
) -> Control | None:
    """What an artist turns to turn a bone: the bone itself where it is free; None where nothing was found."""
    before = channels(armature)
    bone = armature.pose.bones[name]
    axis, angle, _ = max(turns, key=lambda turn: abs(turn[1]))
    if all(constraint.type == "LIMIT_ROTATION" for constraint in bone.constraints):
        turn_about(bone, axis, angle)
        free = all_free(armature, {name: bone.matrix_basis.copy()})
        restore(armature, before, update=False)
        if free:
            return Control(name)
    vector = _world_vector(armature, name, axis, angle)
    return near_control(
        armature,
        name,
        lambda other: turn_bone(armature, other, vector),
        lambda: restore(armature, before, update=False),
    )


def _world_vector(armature: bpy.types.Object, name: str, axis: int, angle: float) -> list[float]:
    """A turn about one of a bone's own axes as `turn_bones` takes it: about the world's, in degrees."""
    about = armature.matrix_world.to_quaternion() @ armature.data.bones[name].matrix_local.to_quaternion()
    turn: Any = about @ mathutils.Vector([float(np.degrees(angle)) * (k == axis) for k in range(3)])
    return [float(value) for value in turn]


@contextmanager
def _turned(
    armature: bpy.types.Object, name: str, control: Control, axis: int, angle: float
) -> Iterator[None]:
    """Inside the block a bone is turned, by its control."""
    before = channels(armature, [control.bone])
    with switched(armature, control.owner, control.prop) if control.prop else nullcontext():
        if control.bone == name:
            turn_about(armature.pose.bones[name], axis, angle)
        else:
            turn_bone(armature, control.bone, _world_vector(armature, name, axis, angle))
        bpy.context.view_layer.update()
        try:
            yield
        finally:
            restore(armature, before, update=False)


def _keys(armature: bpy.types.Object, control: Control) -> list[tuple[str, int]]:
    """The channels that a pose of a control has."""
    bone = armature.pose.bones[control.bone]
    channel = rotation_channel(bone)
    keys = [(bone.path_from_id(channel), index) for index in range(len(getattr(bone, channel)))]
    if control.prop:
        owner = armature.pose.bones[control.owner].path_from_id()
        keys.append((f'{owner}["{bpy.utils.escape_identifier(control.prop)}"]', 0))
    return keys
