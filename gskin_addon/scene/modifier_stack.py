# SPDX-License-Identifier: GPL-3.0-or-later
"""What moves the splats of an object before they are drawn: its modifiers, and how they go beyond vertex groups."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import bpy
import numpy as np

from . import names

_OURS = (names.ROTATION_MODIFIER, names.DISPLAY_MODIFIER, names.ANCHOR_MODIFIER)

_BLIND = frozenset({"SURFACE_DEFORM", "MESH_DEFORM", "MESH_CACHE", "MESH_SEQUENCE_CACHE", "CLOTH", "SOFT_BODY"})
"""Modifiers that move a point by its number: where the point is now, and so what is around it, they do not ask."""


def modifiers_of(obj: bpy.types.Object) -> list[Any]:
    """The object's modifiers that may move the points before they are drawn, switched on or off, in their order."""
    drawn = next((m for m in obj.modifiers if _is_ours(m, (names.DISPLAY_MODIFIER,))), None)
    before = obj.modifiers if drawn is None else obj.modifiers[: obj.modifiers.find(drawn.name)]
    return [modifier for modifier in before if not _is_ours(modifier)]


def deforming_modifiers(obj: bpy.types.Object) -> list[Any]:
    """Those of them that are switched on in the viewport."""
    return [modifier for modifier in modifiers_of(obj) if modifier.show_viewport]


def is_blind(modifier: Any) -> bool:
    """Whether the modifier moves splats without saying how what is around them turns."""
    return modifier.type in _BLIND


def blind(obj: bpy.types.Object) -> list[str]:
    """Names of such modifiers that are switched on."""
    return [modifier.name for modifier in deforming_modifiers(obj) if is_blind(modifier)]


def beyond_groups(obj: bpy.types.Object, stack: Iterable[Any] | None = None) -> list[str]:
    """Why the splats do not move as one armature's bones by their vertex groups say: reasons, none if they do.

    stack: the modifiers that count (default: `deforming_modifiers`). What is blended as rotations (Preserve Volume)
    turns splats by Eq. 3 and is no reason, nor are bendy, scaled and mirrored bones.
    """
    found = []
    stack = list(deforming_modifiers(obj) if stack is None else stack)
    for modifier in stack:
        if modifier.type != "ARMATURE":
            found.append(f"modifier '{modifier.name}' deforms them too")
            continue
        if modifier.object is None:
            continue
        if modifier.use_bone_envelopes:
            found.append(f"'{modifier.name}' uses bone envelopes")
        if not modifier.use_vertex_groups:
            found.append(f"'{modifier.name}' does not use vertex groups")
        if modifier.vertex_group and modifier.vertex_group in obj.vertex_groups:
            found.append(f"'{modifier.name}' is masked by vertex group '{modifier.vertex_group}'")
        bones = modifier.object.data.bones
        if not _may_be_odd(bones):
            continue
        groups = {group.name for group in obj.vertex_groups}
        for bone in bones:
            if bone.use_deform and bone.name in groups:
                if bone.use_envelope_multiply:
                    found.append(f"bone '{bone.name}' multiplies its weights by its envelope")
                if bone.bbone_segments > 1 and getattr(bone, "bbone_mapping_mode", "STRAIGHT") != "STRAIGHT":
                    found.append(f"bone '{bone.name}' has curved segments")
    if sum(modifier.type == "ARMATURE" and modifier.object is not None for modifier in stack) > 1:
        found.append("more than one armature moves them")
    return found


def _may_be_odd(bones: Any) -> bool:
    """Whether any bone multiplies weights by its envelope or has segments; looked up at once, for each pose asks."""
    multiplies, segments = np.zeros(len(bones), np.bool_), np.zeros(len(bones), np.int32)
    bones.foreach_get("use_envelope_multiply", multiplies)
    bones.foreach_get("bbone_segments", segments)
    return bool(multiplies.any() or segments.max(initial=1) > 1)


def _is_ours(modifier: Any, groups: tuple[str, ...] = _OURS) -> bool:
    group = modifier.node_group if modifier.type == "NODES" else None
    return group is not None and group.get("gskin_group") in groups
