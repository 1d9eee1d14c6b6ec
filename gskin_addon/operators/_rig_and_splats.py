# SPDX-License-Identifier: GPL-3.0-or-later
"""When rig and splats may be moved: the rig to splats that do not follow it yet, or splats by their rig."""

from __future__ import annotations

import bpy

from ..scene.bone_frames import armature_of
from ..scene.proxy_object import followed_armature
from ..scene.rig_fit import topmost
from ..scene.splat_object import splat_count
from ..session.chosen import chosen_armature, chosen_splats


def can_move_rig(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether the chosen rig can be moved onto the chosen splats; says by `operator` why not."""
    splats, armature = chosen_splats(context), chosen_armature(context)
    problem = ""
    if splats is None or splat_count(splats) < 2:
        problem = "Choose a splat object"
    elif armature is None or not any(bone.use_deform for bone in armature.data.bones):
        problem = "Choose an armature with deform bones"
    elif splats.mode == "EDIT" or armature.mode == "EDIT":
        problem = "Leave Edit Mode (Tab)"
    elif followed_armature(splats) is not None or topmost(splats) == topmost(armature):
        problem = "The splats follow the armature already and would move along"
    if problem:
        operator.poll_message_set(problem)
    return not problem


def can_pose_splats(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether the chosen splats follow an armature that can be posed now; says by `operator` why not."""
    splats = chosen_splats(context)
    armature = None if splats is None else armature_of(splats)
    problem = ""
    if splats is None or armature is None:
        problem = "Select splats that follow an armature"
    elif splats.mode == "EDIT" or armature.mode == "EDIT":
        problem = "Leave Edit Mode (Tab)"
    if problem:
        operator.poll_message_set(problem)
    return not problem
