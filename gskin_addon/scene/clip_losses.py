# SPDX-License-Identifier: GPL-3.0-or-later
"""What plays in Blender and is in none of the clips of a glTF file: mixes of the NLA, and poses without keys."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from .actions import bones_of, own_parts
from .dependencies import is_animated, needed_objects

_STILL = 1e-5
"""How much an entry of a bone's own matrix is away from rest at least when it was posed."""


def lost_in_clips(armature: bpy.types.Object, *, posed: bool = False) -> list[str]:
    """Sentences about what the armature's clips do not hold of how it moves in Blender.

    posed: the file has the present pose besides, so that bones without keys need no word.
    """
    found = said_of_nla(armature)
    render = bpy.context.scene.render
    if render.frame_map_old != render.frame_map_new:
        found.append(
            f"The scene stretches time ({render.frame_map_old} to {render.frame_map_new}), and the clips of "
            f"'{armature.name}' are cut off by it; set Time Stretching in the Output properties to equal numbers."
        )
    bones = [] if posed else posed_by_hand(armature)
    if bones:
        found.append(
            f"{listed(bones)} of '{armature.name}' {'is' if len(bones) == 1 else 'are'} posed by hand without keys, "
            "and at rest in the clips of the file; key what shall stay."
        )
    return found


def moved_without_joints(obj: bpy.types.Object, armature: bpy.types.Object) -> list[str]:
    """A sentence where splats are animated as an object, besides what their armature does."""
    others: Any = {*needed_objects(armature)}
    above: Any = obj
    while above is not None and above not in others:
        if is_animated([above]) or len(above.constraints):
            return [
                f"glTF moves skinned splats by their joints alone: that '{above.name}' is animated or constrained as "
                f"an object is not in the clips; move '{armature.name}' instead."
            ]
        above = above.parent
    return []


def said_of_nla(armature: bpy.types.Object) -> list[str]:
    """A sentence about tracks of the armature's NLA that do more than play one action, where there are such."""
    mixed = mixed_tracks(armature)
    if not mixed:
        return []
    return [
        f"glTF has clips and no NLA: of '{armature.name}', {'; '.join(mixed)}, and the file does not show it. Its "
        "actions are there, each as a clip of its own."
    ]


def mixed_tracks(armature: bpy.types.Object) -> list[str]:
    """Tracks of the armature's NLA that do more than play one action as it is, and what they do."""
    data: Any = armature.animation_data
    found = []
    for track in [] if data is None else data.nla_tracks:
        strips = [strip for strip in track.strips if not strip.mute]
        if track.mute or not strips:
            continue
        reasons = [f"has {len(strips)} strips"] if len(strips) > 1 else []
        # Without "Animated Influence" the strip's influence is 1 but for what blends in and out, whatever it says.
        if any(strip.use_animated_influence or strip.blend_in or strip.blend_out for strip in strips):
            reasons.append("blends by influence")
        if any(strip.blend_type != "REPLACE" for strip in strips):
            reasons.append("adds to what is below")
        if any(strip.scale != 1 or strip.repeat != 1 or strip.use_reverse for strip in strips):
            reasons.append("plays faster, slower, again or backwards")
        if reasons:
            found.append(f"track '{track.name}' {' and '.join(reasons)}")
    return found


def posed_by_hand(armature: bpy.types.Object) -> list[str]:
    """Bones that do not stand at rest, and that no action of the armature keys and no driver moves."""
    keyed: set[str] = set()
    for part in own_parts(armature):
        keyed |= bones_of(part)
    data: Any = armature.animation_data
    paths = [] if data is None else [driver.data_path for driver in data.drivers]
    return [
        bone.name
        for bone in armature.pose.bones
        if bone.name not in keyed
        and np.abs(np.array(bone.matrix_basis) - np.eye(4)).max() > _STILL
        and not any(path.startswith(bone.path_from_id()) for path in paths)
    ]


def listed(bones: list[str]) -> str:
    """The names in quotes, the first few of many."""
    return ", ".join(f"'{bone}'" for bone in bones[:3]) + (f" and {len(bones) - 3} more" if len(bones) > 3 else "")
