# SPDX-License-Identifier: GPL-3.0-or-later
"""Armature objects that are mirrored by their scale, against finite differences of the modifier and in all outputs."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from bent_rig import bend, bent_rig, bind, segments
from finite_differences import apart, covariances, shown, truth
from glb import Glb

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.sh import eval_sh
from gskin_addon.scene.armature import pose_transforms_of, read_skeleton
from gskin_addon.scene.gltf_export import export_glb
from gskin_addon.scene.posing import posed_cloud, turn_bones
from gskin_addon.scene.splat_object import read_cloud

MIRRORS = [(1, -1, 1), (1.2, 1.2, -1.2)]


@pytest.fixture(params=MIRRORS)
def rig(request):
    """Splats around a mirrored rig that stands askew; bound, at rest."""
    obj, armature = bent_rig()
    for each in (obj, armature):
        each.location, each.rotation_euler = (0.4, -0.2, 0.3), (0.3, 0.2, -0.5)
    armature.scale = request.param
    bpy.context.view_layer.update()
    bind(obj, armature)
    return obj, armature


def test_the_skeleton_is_where_blender_draws_it(rig):
    _, armature = rig
    skeleton, world = read_skeleton(armature), armature.matrix_world
    heads = [world @ bone.head_local for bone in armature.data.bones]
    tails = [world @ bone.tail_local for bone in armature.data.bones]
    np.testing.assert_allclose(skeleton.heads, heads, atol=1e-6)
    np.testing.assert_allclose(skeleton.tails, tails, atol=1e-6)
    ways = skeleton.tails - skeleton.heads
    np.testing.assert_allclose(skeleton.rest[:, :3, 1], ways / np.linalg.norm(ways, axis=1)[:, None], atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(skeleton.rest), 1, atol=1e-5)


def test_at_rest_nothing_moves(rig):
    obj, _ = rig
    live, rest = shown(obj), read_cloud(obj, world=False)
    np.testing.assert_allclose(live.points, rest.means, atol=1e-6)
    np.testing.assert_allclose(np.abs(live.turn[:, 0]), 1, atol=1e-6)


@pytest.mark.parametrize("scaled", [False, True])
def test_splats_turn_as_the_modifier_turns_them(rig, scaled):
    obj, armature = rig
    weights = bind(obj, armature)
    bend(armature)
    if scaled:
        armature.pose.bones["b2"].scale = (0.7, 1.8, 1.2)
    live, real, rest = shown(obj), truth(obj), read_cloud(obj, world=False)
    np.testing.assert_allclose(live.points, real.points, atol=1e-5)
    alone = weights.max(axis=1) > 0.999
    assert alone.sum() > 40
    assert real.turn_error(live.turn)[alone].max() < 1
    held = apart(covariances(live.quats, live.scales), real.covariances(rest.quats, rest.scales))
    assert held[alone].max() < 0.02
    posed, world = posed_cloud(obj), np.array(obj.matrix_world, float)[:3, :3]
    np.testing.assert_allclose(posed.means, live.points @ world.T + np.array(obj.matrix_world)[:3, 3], atol=1e-5)
    in_world = world @ covariances(live.quats, live.scales) @ world.T
    assert apart(in_world, covariances(posed.quats, posed.scales)).max() < 1e-3


def test_a_bone_turns_about_the_axis_that_was_asked_for(rig):
    _, armature = rig
    turn_bones(armature, {"b0": (0, 0, 90)})
    np.testing.assert_allclose(
        pose_transforms_of(armature)[0, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-5
    )


def test_colours_turn_along_and_are_not_mirrored(rig):
    obj, armature = rig
    turn_bones(armature, {"b0": (20, -50, 70)})
    rest, posed, turn = read_cloud(obj), posed_cloud(obj), pose_transforms_of(armature)[0, :3, :3]
    ways = np.random.default_rng(0).normal(size=(rest.count, 3)).astype(np.float32)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    np.testing.assert_allclose(
        eval_sh(posed.sh, (ways @ turn.T).astype(np.float32)), eval_sh(rest.sh, ways), atol=1e-4
    )


def test_the_rig_carries_the_splats_when_it_is_moved(rig):
    obj, armature = rig
    bend(armature)
    before, place = posed_cloud(obj).means, armature.matrix_world.copy()
    armature.location.x += 2
    armature.rotation_euler.z += 0.7
    bpy.context.view_layer.update()
    moved = np.array(armature.matrix_world @ place.inverted(), float)
    np.testing.assert_allclose(posed_cloud(obj).means, before @ moved[:3, :3].T + moved[:3, 3], atol=1e-5)


def test_a_file_has_the_pose(rig, tmp_path):
    obj, armature = rig
    bend(armature)
    out = tmp_path / "out.glb"
    export_glb(out, [obj], posed=True)
    glb, wanted = Glb(out), posed_cloud(obj).means
    assert np.abs(glb.posed(glb.node("Splats")) - wanted).max() < 1e-4 * np.ptp(wanted, axis=0).max()


def test_segments_cannot_be_mirrored():
    _, armature = bent_rig()
    armature.scale = (-1, 1, 1)
    segments(armature, 3)
    with pytest.raises(InputError, match=r"'Rig' is mirrored.*Apply > Scale"):
        read_skeleton(armature)
    segments(armature, 1)
    read_skeleton(armature)


def test_mirrored_splats_are_refused():
    obj, _ = bent_rig()
    obj.scale = (-1, 1, 1)
    with pytest.raises(InputError, match="'Splats' is mirrored"):
        read_cloud(obj)
