# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigify's human: 706 bones, of which artists turn few; the deform bones among them say which."""

from __future__ import annotations

import re

import bpy
import figure_rig as fig
import numpy as np
import pytest

from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.scene.armature import read_skeleton
from gskin_addon.scene.splat_object import create_splat_object
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


def test_an_fk_control_in_ik_says_what_to_switch(human, tmp_path, capfd):
    assert fig.run("pose", human, "--out", tmp_path / "out.ply", "--rotate", "upper_arm_fk.L", 0, -60, 0) == 2
    assert "moves no splats of 'human'; set 'IK_FK' of 'upper_arm_parent.L' to 1 first" in capfd.readouterr().err
