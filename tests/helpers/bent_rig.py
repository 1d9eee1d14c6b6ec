# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats around a chain of four crooked bones, for bones that do more than turn."""

from __future__ import annotations

import itertools
from typing import Any

import bpy
import numpy as np

from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.scene.armature import read_skeleton
from gskin_addon.scene.posing import turn_bones
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import write_weights

SPLATS = 400


def bent_rig() -> tuple[Any, Any]:
    """Splats around a chain of four crooked bones, the middle two of which may get segments."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    joints = [(0, 0, 0), (0.5, 0.1, 0), (1.0, 0, 0.1), (1.5, 0.1, 0), (1.9, 0, 0)]
    for index, (head, tail) in enumerate(itertools.pairwise(joints)):
        bone = armature.data.edit_bones.new(f"b{index}")
        bone.head, bone.tail, bone.roll = head, tail, 0.3 * index
        if index:
            bone.parent, bone.use_connect = armature.data.edit_bones[index - 1], True
    bpy.ops.object.mode_set(mode="OBJECT")
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(SPLATS, 4))
    cloud = SplatCloud(
        means=rng.uniform((-0.05, -0.1, -0.1), (1.95, 0.2, 0.2), (SPLATS, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=rng.uniform((0.004, 0.01, 0.02), (0.008, 0.02, 0.04), (SPLATS, 3)),
        opacities=np.full(SPLATS, 0.9),
        sh=rng.normal(size=(SPLATS, 4, 3)),
    )
    return create_splat_object(cloud, "Splats"), armature


def bind(obj: Any, armature: Any, sharpness: float = 40.0) -> np.ndarray:
    """Weights (N, 4) by distance to the bones; the splats follow them."""
    skeleton, points = read_skeleton(armature), read_cloud(obj).means
    ways = skeleton.tails - skeleton.heads
    along = np.einsum("nbd,bd->nb", points[:, None] - skeleton.heads, ways) / (ways**2).sum(axis=1)
    foot = skeleton.heads + np.clip(along, 0, 1)[:, :, None] * ways
    near = np.exp(-sharpness * np.linalg.norm(points[:, None] - foot, axis=2))
    weights = (near / near.sum(axis=1, keepdims=True)).astype(np.float32)
    write_weights(obj, armature, weights)
    return weights


def segments(armature: Any, count: int) -> None:
    """Give the middle two bones segments."""
    for name in ("b1", "b2"):
        armature.data.bones[name].bbone_segments = count


def bend(armature: Any) -> None:
    """Turn all but the first bone."""
    turn_bones(armature, {"b1": (10, -40, 20), "b2": (0, -30, 25), "b3": (30, 0, 10)})
