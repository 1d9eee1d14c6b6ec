# SPDX-License-Identifier: GPL-3.0-or-later
"""Armatures, weights and posed splats in Blender, for tests of the scene layer."""

from __future__ import annotations

import time

import bpy
import numpy as np

from gskin_addon.core.rig.lbs import skin_points, skin_quats
from gskin_addon.core.rig.quaternion import matrix_to_quat, normalize, quat_multiply
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.scene.armature import pose_transforms_of
from gskin_addon.scene.attributes import read_attribute, read_positions
from gskin_addon.scene.node_groups import find_display, set_display
from gskin_addon.scene.splat_object import read_cloud
from gskin_addon.scene.transforms import world_similarity
from gskin_addon.scene.weights import read_weights


def make_chains(bones: int, rng: np.random.Generator, *, chain: int = 5, name: str = "Rig") -> bpy.types.Object:
    """An armature of crooked chains with random rolls, about two metres tall."""
    armature = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    previous = None
    for index in range(bones):
        bone = armature.data.edit_bones.new(f"bone.{index:03d}")
        bone.head = (*rng.normal(0, 0.1, 2), 2 * index / bones)
        bone.tail = bone.head + type(bone.head)((*rng.normal(0, 0.02, 2), 2 / bones))
        bone.roll = rng.uniform(-3, 3)
        bone.parent = previous if index % chain else None
        previous = bone
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


def place(obj: bpy.types.Object, location, angles, scale: float) -> None:
    obj.location, obj.rotation_euler, obj.scale = location, angles, (scale,) * 3
    bpy.context.view_layer.update()


def random_pose(armature: bpy.types.Object, rng: np.random.Generator, angle: float = 0.4) -> None:
    for bone in armature.pose.bones:
        bone.rotation_mode = "QUATERNION"
        bone.rotation_quaternion = normalize(np.array([1, *rng.normal(0, angle, 3)]))
    bpy.context.view_layer.update()


def random_weights(cloud: SplatCloud, bones: int, rng: np.random.Generator) -> np.ndarray:
    """(N, B) float32 smooth weights, with every bone somewhere."""
    anchors = cloud.means[rng.choice(cloud.count, bones)]
    near = np.exp(-4 * np.linalg.norm(cloud.means[:, None] - anchors, axis=2))
    return (near / near.sum(axis=1, keepdims=True)).astype(np.float32)


def posed_in_blender(obj: bpy.types.Object, depsgraph=None) -> tuple[np.ndarray, np.ndarray]:
    """World positions (N, 3) and quaternions (N, 4) that Blender's modifiers give, display off."""
    if find_display(obj) is not None:
        set_display(obj, "Display", False)
    evaluated = obj.evaluated_get(depsgraph or bpy.context.evaluated_depsgraph_get())
    points = read_positions(evaluated.data).astype(np.float64)
    quats = read_attribute(evaluated.data, "rotation").astype(np.float64)
    rotation, scale, translation = world_similarity(obj)
    return points @ rotation.T * scale + translation, quat_multiply(matrix_to_quat(rotation), quats)


def posed_in_numpy(obj: bpy.types.Object, armature: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """The same by Eq. 1 and Eq. 3 in float64, from the rest splats, the vertex groups and the armature's pose."""
    cloud = read_cloud(obj)
    weights = read_weights(obj)[0].astype(np.float64)
    weights /= weights.sum(axis=1, keepdims=True)
    transforms = pose_transforms_of(armature)
    points = skin_points(cloud.means.astype(np.float64), weights, transforms)
    return points, quat_multiply(skin_quats(weights, transforms), cloud.quats.astype(np.float64))


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) angles in radians between rotations, exact for small ones."""
    half = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1)) / 2
    return 4 * np.arcsin(np.clip(half, 0, 1))


def assert_same_pose(obj: bpy.types.Object, armature: bpy.types.Object, depsgraph=None) -> None:
    """Blender against numpy: 1e-5 of the object's size, 1e-4 rad."""
    points, quats = posed_in_blender(obj, depsgraph)
    wanted_points, wanted_quats = posed_in_numpy(obj, armature)
    size = np.linalg.norm(np.ptp(wanted_points, axis=0))
    assert np.abs(points - wanted_points).max() < 1e-5 * size
    assert angles_between(quats, wanted_quats).max() < 1e-4


def pose_change_cost(armature: bpy.types.Object, bone: str) -> float:
    """Processor seconds of one pose change, least of eight.

    Of all threads together, so it bounds the waiting time on two cores by half, and other work on the machine does
    not count.
    """
    taken = []
    for angle in np.linspace(0.1, 0.5, 8):
        armature.pose.bones[bone].rotation_quaternion = (1, angle, 0, 0)
        began = time.process_time()
        bpy.context.view_layer.update()
        taken.append(time.process_time() - began)
    return min(taken)
