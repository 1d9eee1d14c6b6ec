# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigify's human: 706 bones, of which artists turn few; the deform bones among them say which."""

from __future__ import annotations

import re

import bpy
import figure_rig as fig
import numpy as np
import pytest

from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.scene.armature import pose_transforms_of, read_skeleton
from gskin_addon.scene.pose_assets import write_pose
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.steps import run_to_end
from gskin_addon.scene.test_poses import iter_test_poses
from gskin_addon.scene.weights import write_weights


@pytest.fixture(scope="module")
def human(tmp_path_factory):
    """A file with the generated rig and eight splats on each deform bone."""
    fig.empty()
    try:
        bpy.ops.preferences.addon_enable(module="rigify")
    except (RuntimeError, ModuleNotFoundError, ImportError):
        pytest.skip("this Blender has no Rigify")
    bpy.ops.object.armature_human_metarig_add()
    meta = bpy.context.object
    bpy.ops.pose.rigify_generate()
    armature = next(obj for obj in bpy.data.objects if obj.type == "ARMATURE" and obj != meta)
    bpy.data.objects.remove(meta)
    skeleton = read_skeleton(armature)
    along = np.linspace(0.1, 0.9, 8)[:, None]
    means = np.concatenate([h + along * (t - h) for h, t in zip(skeleton.heads, skeleton.tails, strict=True)])
    count = len(means)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    cloud = SplatCloud(means, quats, np.full((count, 3), 0.01), np.full(count, 0.9), np.zeros((count, 1, 3)))
    obj = create_splat_object(cloud, "human", display=False)
    write_weights(obj, armature, np.repeat(np.eye(skeleton.count, dtype=np.float32), 8, axis=0))
    path = tmp_path_factory.mktemp("rigify") / "human.blend"
    fig.save(path)
    return path


@pytest.mark.parametrize(("bone", "control"), [("DEF-upper_arm.L", "upper_arm_fk.L"), ("DEF-spine.006", "head")])
def test_a_bone_that_is_held_names_a_control_that_moves_it(bone, control, human, tmp_path, capfd):
    out = tmp_path / "out.ply"
    turn = (0, -30, 0) if "arm" in bone else (-30, 0, 0)
    assert fig.run("pose", human, "--out", out, "--rotate", bone, *turn) == 2
    error = capfd.readouterr().err
    assert f"'{bone}' of 'rig' cannot be turned, because its rotation is held" in error
    assert f"turn '{control}' instead" in error
    # What it says is so.
    switch = re.search(r"--set (\S+) (\S+) (\S+)\)", error)
    assert (switch is not None) == ("arm" in bone)
    settings = ("--set", *switch.groups()) if switch else ()
    means = fig.posed_means(human, *settings, "--rotate", control, *turn)
    assert np.abs(means - fig.posed_means(human, *settings)).max() > 0.01


def test_test_poses_turn_the_controls_and_take_them_back(human):
    bpy.ops.wm.open_mainfile(filepath=str(human))
    obj, armature = bpy.data.objects["human"], bpy.data.objects["rig"]
    bones = read_skeleton(armature).names
    moved = ("DEF-upper_arm.L", "DEF-shin.R", "DEF-spine.006")
    carried = (*moved, "DEF-thigh.L.001")  # the last is half of a bone, and turns with the other half
    weights = np.zeros((len(obj.data.vertices), len(bones)), np.float32)
    weights[np.arange(len(weights)), [bones.index(carried[i % 4]) for i in range(len(weights))]] = 1
    write_weights(obj, armature, weights)
    before = [tuple(map(tuple, bone.matrix_basis)) for bone in armature.pose.bones]
    found = run_to_end(iter_test_poses(obj, (0, -1, 0)))
    assert "DEF-thigh.L.001" in found.held
    assert not set(moved) & set(found.held)
    assert [tuple(map(tuple, bone.matrix_basis)) for bone in armature.pose.bones] == before
    assert armature.pose.bones["upper_arm_parent.L"]["IK_FK"] == 0
    poses = {pose.name: pose for pose in found.poses}
    assert {"upper_arm_fk.L Up", "upper_arm_fk.L Down", "shin_fk.R Back", "head Left", "Rest"} <= set(poses)
    assert not any(name.startswith("root") for name in poses), "that turns the whole figure"
    # The arm stretches to its side, the leg hangs down.
    assert ('pose.bones["upper_arm_parent.L"]["IK_FK"]', 0) in poses["upper_arm_fk.L Up"].values
    for control in armature.pose.bones:  # Blender poses the selected bones, or all where none is
        (control if hasattr(control, "select") else control.bone).select = False
    for name, bone in (("upper_arm_fk.L Up", moved[0]), ("shin_fk.R Back", moved[1]), ("head Left", moved[2])):
        armature.pose.apply_pose_from_action(write_pose(armature, poses[name]))
        armature.update_tag()
        bpy.context.view_layer.update()
        change = pose_transforms_of(armature)[bones.index(bone)][:3, :3]
        turned = np.degrees(np.arccos(np.clip((np.trace(change) - 1) / 2, -1, 1)))
        assert 40 < turned < 62, name
        wanted = found.transforms[found.poses.index(poses[name])][bones.index(bone)]
        np.testing.assert_allclose(pose_transforms_of(armature)[bones.index(bone)], wanted, atol=1e-4)
        armature.pose.apply_pose_from_action(write_pose(armature, poses["Rest"]))
        armature.update_tag()
        bpy.context.view_layer.update()
        np.testing.assert_allclose(pose_transforms_of(armature), found.transforms[-1], atol=1e-4)


def test_an_fk_control_in_ik_says_what_to_switch(human, tmp_path, capfd):
    assert fig.run("pose", human, "--out", tmp_path / "out.ply", "--rotate", "upper_arm_fk.L", 0, -60, 0) == 2
    assert "moves no splats of 'human'; set 'IK_FK' of 'upper_arm_parent.L' to 1 first" in capfd.readouterr().err
