# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender armatures as skeletons and deform transforms."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs

bpy = pytest.importorskip("bpy")

from mathutils import Matrix

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.quaternion import axis_angle_to_matrix
from gskin_addon.scene.armature import deform_bone_names, pose_transforms_of, read_skeleton


@pytest.fixture(autouse=True)
def empty():
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_only_deform_bones_with_their_nearest_deform_parent(rng):
    armature = rigs.make_chains(5, rng)
    armature.data.bones["bone.001"].use_deform = False
    armature.data.bones["bone.003"].use_deform = False
    skeleton = read_skeleton(armature)
    assert skeleton.names == ("bone.000", "bone.002", "bone.004")
    assert skeleton.parents.tolist() == [-1, 0, 1]
    assert deform_bone_names(armature) == list(skeleton.names)


def test_a_control_root_leaves_several_roots(rng):
    armature = rigs.make_chains(3, rng)
    armature.data.bones["bone.000"].use_deform = False
    assert read_skeleton(armature).parents.tolist() == [-1, 0]


def test_world_space_with_the_object_transform(rng):
    armature = rigs.make_chains(4, rng)
    rigs.place(armature, (1, 2, 3), (0.4, 0.5, 0.6), 0.01)
    skeleton = read_skeleton(armature)
    for index, name in enumerate(skeleton.names):
        bone = armature.data.bones[name]
        np.testing.assert_allclose(skeleton.heads[index], armature.matrix_world @ bone.head_local, atol=1e-6)
        np.testing.assert_allclose(skeleton.tails[index], armature.matrix_world @ bone.tail_local, atol=1e-6)
        # A bone's y axis points to its tail; the rest matrix carries no scale.
        along = skeleton.tails[index] - skeleton.heads[index]
        np.testing.assert_allclose(skeleton.rest[index, :3, 1], along / np.linalg.norm(along), atol=1e-5)
        np.testing.assert_allclose(skeleton.rest[index, :3, 3], skeleton.heads[index])


def test_pose_transforms_follow_eq_2(rng):
    """Turning pose bones by world-axis rotations gives the transforms of core's kinematics."""
    armature = rigs.make_chains(6, rng, chain=3)
    rigs.place(armature, (0.5, 0, -1), (0.1, 0.7, -0.3), 1.3)
    skeleton = read_skeleton(armature)
    turns = axis_angle_to_matrix(rng.normal(size=(6, 3)), rng.uniform(-1, 1, 6))
    for index, name in enumerate(skeleton.names):
        rest = skeleton.rest[index, :3, :3]
        local = rest.T @ turns[index] @ rest
        bone = armature.pose.bones[name]
        bone.rotation_mode = "QUATERNION"
        bone.rotation_quaternion = Matrix(local.tolist()).to_quaternion()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(pose_transforms_of(armature), pose_transforms(skeleton, turns), atol=2e-6)


def test_rest_pose_gives_identities(rng):
    armature = rigs.make_chains(4, rng)
    rigs.place(armature, (3, 2, 1), (1, 1, 1), 2.0)
    np.testing.assert_allclose(pose_transforms_of(armature), np.tile(np.eye(4), (4, 1, 1)), atol=1e-5)


def test_no_deform_bones(rng):
    armature = rigs.make_chains(2, rng, name="Controls")
    for bone in armature.data.bones:
        bone.use_deform = False
    with pytest.raises(InputError, match="'Controls' has no deform bones"):
        read_skeleton(armature)


def test_zero_length_bone(rng):
    """Edit Mode removes bones shorter than 1e-6; next to a large skeleton longer ones are as useless."""
    armature = rigs.make_chains(3, rng)
    bpy.ops.object.mode_set(mode="EDIT")
    bones = armature.data.edit_bones
    bones["bone.000"].head = (0, 0, -200)
    bones["bone.002"].tail = bones["bone.002"].head
    bones["bone.002"].tail.x += 5e-6
    bpy.ops.object.mode_set(mode="OBJECT")
    with pytest.raises(InputError, match=r"'bone\.002' of armature 'Rig' has zero length"):
        read_skeleton(armature)


@pytest.mark.parametrize("scale", [(1, 2, 1), (1, 2, -1), (1, 0, 1)])  # one mirrored evenly: test_mirrored_rig.py
def test_uneven_scale(rng, scale):
    armature = rigs.make_chains(2, rng)
    armature.scale = scale
    with pytest.raises(InputError, match=r"'Rig'.*Apply > Scale"):
        read_skeleton(armature)


def test_not_an_armature():
    with pytest.raises(InputError, match="'Cube' is no armature"):
        read_skeleton(bpy.data.objects.new("Cube", None))
