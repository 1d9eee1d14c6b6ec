# SPDX-License-Identifier: GPL-3.0-or-later
"""A plain rig for the sample character: three bones, and weights by distance."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

TURNS = {"upper_arm": (0, -60, 20), "spine": (20, 0, 15), "head": (0, 10, 40)}
"""Every bone, and degrees about its axes."""


def armature() -> Any:
    """Three bones about where the sample character has them."""
    rig = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    places = {
        "spine": ((0, 0, 0.6), (0, 0, 1.0), None),
        "head": ((0, 0, 1.1), (0, 0, 1.5), "spine"),
        "upper_arm": ((0.13, 0, 0.97), (0.6, 0, 0.65), "spine"),
    }
    for name, (head, tail, parent) in places.items():
        bone = rig.data.edit_bones.new(name)
        bone.head, bone.tail = head, tail
        bone.parent = rig.data.edit_bones[parent] if parent else None
    bpy.ops.object.mode_set(mode="OBJECT")
    return rig


def distance_weights(points: np.ndarray, rig: Any) -> np.ndarray:
    """Soft weights (N, bones) by distance to the bones' middles."""
    middles = np.array([(rig.data.bones[name].head_local + rig.data.bones[name].tail_local) / 2 for name in TURNS])
    near = np.exp(-8 * np.linalg.norm(points[:, None] - middles, axis=2))
    return (near / near.sum(axis=1, keepdims=True)).astype(np.float32)
