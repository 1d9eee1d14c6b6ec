# SPDX-License-Identifier: GPL-3.0-or-later
"""The clip of an armature that moves it fastest, as matrices of its bones."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

FRAMES = 24
_LOOKS = 5
_MOST_CLIPS = 60


def liveliest_clip(armature: bpy.types.Object) -> tuple[str, Array] | None:
    """Name and deform transforms (24, B, 4, 4), pose x inverse(rest) in the world, of the action that moves the
    bones' tails fastest; None where no action moves them.

    Each action of the file is played on the armature, which is left in the last one. At most 60 are looked at.
    """
    actions = [action for action in bpy.data.actions if _moves_bones(action, armature)][:_MOST_CLIPS]
    armature.data.pose_position = "POSE"
    data: Any = armature.animation_data_create()
    data.use_nla = False
    lengths = np.array([bone.length for bone in armature.data.bones])
    best, most = None, 0.0
    for action in actions:
        posed = _played(armature, action, _LOOKS)
        tails = posed[..., :3, 3] + posed[..., :3, 1] * lengths[:, None]
        begin, end = np.array(action.frame_range).tolist()
        motion = float(np.linalg.norm(np.diff(tails, axis=0), axis=-1).mean()) / max(end - begin, 1.0)
        if motion > most * 1.0001:
            best, most = action, motion
    if best is None or most < 1e-6 * lengths.max():
        return None
    rest = np.array([np.array(bone.matrix_local, np.float64) for bone in armature.data.bones])
    world = np.array(armature.matrix_world, np.float64)
    posed = _played(armature, best, FRAMES)
    return best.name, world @ posed @ np.linalg.inv(rest) @ np.linalg.inv(world)


def _moves_bones(action: bpy.types.Action, armature: bpy.types.Object) -> bool:
    paths = {f'pose.bones["{bpy.utils.escape_identifier(bone.name)}"]' for bone in armature.data.bones}
    return any(curve.data_path.rpartition(".")[0] in paths for curve in _curves(action))


def _curves(action: Any) -> list[Any]:
    if not hasattr(action, "layers"):  # before Blender 4.4
        return list(action.fcurves)
    bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    return [curve for bag in bags for curve in bag.fcurves]


def _played(armature: bpy.types.Object, action: bpy.types.Action, count: int) -> Array:
    """Matrices (count, B, 4, 4) of the posed bones in the armature's space, evenly over the action."""
    data: Any = armature.animation_data
    for bone in armature.pose.bones:
        bone.matrix_basis.identity()
    data.action = action
    if hasattr(data, "action_slot") and data.action_slot is None and data.action_suitable_slots:
        data.action_slot = data.action_suitable_slots[0]
    scene: Any = bpy.context.scene
    matrices = []
    first, last = np.array(action.frame_range).tolist()
    for time in np.linspace(first, last, count).tolist():
        scene.frame_set(int(time // 1), subframe=time % 1)
        posed: Any = armature.evaluated_get(bpy.context.evaluated_depsgraph_get()).pose
        matrices.append([np.array(posed.bones[bone.name].matrix, np.float64) for bone in armature.data.bones])
    return np.array(matrices)
