# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights as vertex groups, and posed splats in Blender against numpy."""

from __future__ import annotations

import time

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds
from finite_differences import shown, truth

bpy = pytest.importorskip("bpy")

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.lbs import sparsify
from gskin_addon.scene import names
from gskin_addon.scene.attributes import read_attribute
from gskin_addon.scene.bone_frames import is_bone_frames
from gskin_addon.scene.node_groups import set_display
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.rotation_nodes import frames_of
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import (
    bind,
    follows_foreign_frames,
    read_weights,
    repoint_frames,
    update_rotation_weights,
    write_weights,
)

COUNT, BONES = 500, 7


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture
def rig(rng):
    """Splats, armature, weights; both objects have a transform of their own."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    cloud = clouds.random_cloud(COUNT, 1)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(BONES, rng)
    rigs.place(armature, (1, 2, 0.3), (0.3, 0.4, 0.5), 1.7)
    rigs.place(obj, (0.5, -0.2, 0.3), (0.1, 0.9, -0.5), 0.7)
    return obj, armature, rigs.random_weights(cloud, BONES, rng)


def test_weights_come_back_as_the_strongest_four(rig):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    back, bones = read_weights(obj)
    assert bones == [bone.name for bone in armature.data.bones]
    np.testing.assert_allclose(back, sparsify(weights, 4), atol=1e-7)
    assert max(len(v.groups) for v in obj.data.vertices) == 4


def test_without_a_limit_every_bone_moves_the_splats(rig, rng):
    obj, armature, weights = rig
    write_weights(obj, armature, weights, max_influences=0)
    np.testing.assert_allclose(read_weights(obj)[0], weights, atol=1e-6)
    rigs.random_pose(armature, rng, 0.8)
    points, _ = rigs.posed_in_blender(obj)
    wanted, _ = rigs.posed_in_numpy(obj, armature)
    np.testing.assert_allclose(points, wanted, atol=1e-5 * np.ptp(wanted))


@pytest.mark.parametrize("influences", [1, 2, 4])
def test_posed_splats_agree_with_numpy(rig, rng, influences):
    obj, armature, weights = rig
    write_weights(obj, armature, weights, max_influences=influences)
    assert max(len(v.groups) for v in obj.data.vertices) == influences
    for _ in range(3):
        rigs.random_pose(armature, rng, 0.8)
        rigs.assert_same_pose(obj, armature)


def test_binding_moves_nothing_and_the_armature_carries_the_splats(rig, rng):
    obj, armature, weights = rig
    before = read_cloud(obj)
    write_weights(obj, armature, weights)
    after = read_cloud(obj)
    np.testing.assert_allclose(after.means, before.means, atol=1e-6)
    points, _ = rigs.posed_in_blender(obj)
    np.testing.assert_allclose(points, before.means, atol=1e-5)
    armature.location.x += 2.0
    np.testing.assert_allclose(read_cloud(obj).means, before.means + np.array([2.0, 0, 0]), atol=1e-5)
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)


def test_pose_at_binding_time_does_not_matter(rig, rng):
    obj, armature, weights = rig
    rigs.random_pose(armature, rng)
    before = read_cloud(obj)
    write_weights(obj, armature, weights)
    np.testing.assert_allclose(read_cloud(obj).means, before.means, atol=1e-6)
    rigs.assert_same_pose(obj, armature)


def test_moved_objects_after_binding(rig, rng):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    rigs.random_pose(armature, rng)
    rigs.place(armature, (-3, 1, 2), (1.3, -0.4, 2.5), 0.4)
    rigs.assert_same_pose(obj, armature)
    rigs.place(obj, (0.1, 0.2, 0.3), (2.1, 0.9, -0.5), 2.0)
    rigs.assert_same_pose(obj, armature)


def test_half_turns_keep_signs_aligned(rig):
    """Quaternions that disagree in sign must not cancel."""
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    for index, bone in enumerate(armature.pose.bones):
        bone.rotation_mode = "XYZ"
        bone.rotation_euler = (3.0 * (-1) ** index, 0.2 * index, 0.1)
    bpy.context.view_layer.update()
    rigs.assert_same_pose(obj, armature)


def test_uniformly_scaled_pose_bones(rig, rng):
    """All by one factor: Eq. 3. One bone alone: the map of the blend, to a degree of the modifier's differences.

    The second was asked to be Eq. 3, too, which is up to 11 degrees off the modifier where bones of different sizes
    are blended; issue 18 asks for one degree.
    """
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    rigs.random_pose(armature, rng)
    roots = [bone for bone in armature.pose.bones if bone.parent is None]
    for bone in roots:
        bone.scale = (1.5, 1.5, 1.5)
    bpy.context.view_layer.update()
    rigs.assert_same_pose(obj, armature)
    for bone in roots:
        bone.scale = (1, 1, 1)
    armature.pose.bones[2].scale = (1.5, 1.5, 1.5)
    bpy.context.view_layer.update()
    points, quats = rigs.posed_in_blender(obj)
    wanted = posed_cloud(obj)
    assert np.abs(points - wanted.means).max() < 1e-5 * np.linalg.norm(np.ptp(wanted.means, axis=0))
    assert rigs.angles_between(quats, wanted.quats.astype(np.float64)).max() < 1e-4
    scaled = {b.name for b in [armature.pose.bones[2], *armature.pose.bones[2].children_recursive]}
    columns = [place for place, bone in enumerate(armature.data.bones) if bone.name in scaled]
    share = sparsify(weights, 4)[:, columns].sum(axis=1)
    blended = (share > 0.01) & (share < 0.99)
    assert blended.sum() > 20
    assert truth(obj).turn_error(shown(obj).turn)[blended].max() < 1


def test_columns_in_another_order_and_missing_bones(rig, rng):
    obj, armature, weights = rig
    order = rng.permutation(BONES)[:5]
    bones = [armature.data.bones[int(b)].name for b in order]
    part = weights[:, order] / weights[:, order].sum(axis=1, keepdims=True)
    write_weights(obj, armature, part, bones)
    back, _ = read_weights(obj, bones)
    np.testing.assert_allclose(back, sparsify(part, 4), atol=1e-6)
    assert len(obj.vertex_groups) == BONES
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)


def test_writing_again_replaces(rig, rng):
    obj, armature, weights = rig
    obj.vertex_groups.new(name="Mask").add([1, 2, 3], 0.5, "REPLACE")
    write_weights(obj, armature, weights)
    modifiers = [m.name for m in obj.modifiers]
    write_weights(obj, armature, weights[:, ::-1], max_influences=2)
    np.testing.assert_allclose(read_weights(obj)[0], sparsify(weights[:, ::-1], 2), atol=1e-7)
    np.testing.assert_allclose(read_weights(obj, ["Mask"])[0].sum(), 1.5)
    assert [m.name for m in obj.modifiers] == modifiers == ["Armature", "GSkin Rotation", "GSkin Display"]
    assert sum(is_bone_frames(o) for o in bpy.data.objects) == 1
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)


def test_splats_without_weights_stay(rig, rng):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    everyone = list(range(10))
    for group in obj.vertex_groups:
        group.remove(everyone)
    update_rotation_weights(obj)
    rest = read_cloud(obj)
    rigs.random_pose(armature, rng)
    points, quats = rigs.posed_in_blender(obj)
    np.testing.assert_allclose(points[:10], rest.means[:10], atol=1e-5)
    assert rigs.angles_between(quats[:10], rest.quats[:10]).max() < 1e-5
    assert rigs.angles_between(quats[10:], rest.quats[10:]).max() > 0.1


def test_painted_weights_are_taken_over(rig, rng):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    for group in obj.vertex_groups:
        group.remove(list(range(COUNT)))
    obj.vertex_groups["bone.003"].add(list(range(COUNT)), 0.3, "REPLACE")  # not normalised: an artist's value
    obj.vertex_groups["bone.005"].add(list(range(0, COUNT, 2)), 0.1, "REPLACE")
    update_rotation_weights(obj)
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)


def test_renamed_bones_and_new_bones(rig, rng):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    armature.data.bones["bone.002"].name = "knee"
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)
    armature.data.bones["bone.000"].use_deform = False
    update_rotation_weights(obj)
    bpy.context.view_layer.update()
    bones = [b.name for b in armature.data.bones if b.use_deform]
    assert [g.name for g in frames_of(obj).vertex_groups] == bones


def test_the_helper_is_out_of_the_way_and_survives_the_file(rig, rng, tmp_path):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    helpers = [o for o in bpy.data.objects if o.name not in bpy.context.scene.objects]
    assert [o for o in helpers if is_bone_frames(o)]
    assert all(not o.users_collection and o.parent is None for o in helpers)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "s.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "s.blend"))
    obj, armature = bpy.data.objects["S"], bpy.data.objects["Rig"]
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)


def test_a_copy_of_the_splats_follows_too(rig, rng):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    copy = obj.copy()
    copy.data = obj.data.copy()
    bpy.context.scene.collection.objects.link(copy)
    rigs.place(copy, (4, 0, 0), (0, 0, 1.0), 1.0)
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(copy, armature)
    rigs.assert_same_pose(obj, armature)


def repair_frames(obj):
    """What follows a copy of splats and armature by itself, at once. True if it was needed."""
    if not follows_foreign_frames(obj):
        return False
    if not repoint_frames(obj):
        update_rotation_weights(obj)
    return True


def test_a_copy_with_its_own_armature_is_repaired(rig, rng):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    bpy.ops.object.select_all(action="DESELECT")
    obj.select_set(True)
    armature.select_set(True)
    bpy.ops.object.duplicate()
    copy, own = bpy.data.objects["S.001"], bpy.data.objects["Rig.001"]
    assert repair_frames(copy)
    assert not repair_frames(copy)
    rigs.random_pose(own, rng)
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(copy, own)
    rigs.assert_same_pose(obj, armature)


def test_an_animation_needs_no_python(rig, rng):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    rigs.random_pose(armature, rng)
    for bone in armature.pose.bones:
        bone.keyframe_insert("rotation_quaternion", frame=1)
    rigs.random_pose(armature, rng)
    for bone in armature.pose.bones:
        bone.keyframe_insert("rotation_quaternion", frame=20)
    bpy.context.scene.frame_set(11)
    rigs.assert_same_pose(obj, armature)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w[:-1], "shape"),
        (lambda w: w[:, :-1], "shape"),
        (lambda w: w * np.nan, "NaN"),
        (lambda w: -w, "negative"),
    ],
)
def test_wrong_weights_change_nothing(rig, change, message):
    obj, armature, weights = rig
    with pytest.raises(InputError, match=message):
        write_weights(obj, armature, change(weights))
    assert not obj.vertex_groups
    assert [m.type for m in obj.modifiers] == ["NODES"]


def test_unknown_bones_and_uneven_scale_change_nothing(rig):
    obj, armature, weights = rig
    bones = [f"x{b}" for b in range(BONES)]
    with pytest.raises(InputError, match="'Rig' has no deform bone 'x0'"):
        write_weights(obj, armature, weights, bones)
    obj.scale = (1, 2, 1)
    with pytest.raises(InputError, match="'S' is scaled unevenly"):
        write_weights(obj, armature, weights)
    assert not obj.vertex_groups
    assert obj.parent is None


def test_unbound_objects_are_refused(rig):
    obj, _, _ = rig
    for call in (read_weights, update_rotation_weights):
        with pytest.raises(InputError, match="'S' follows no armature"):
            call(obj)
    with pytest.raises(InputError, match="is no armature"):
        bind(obj, obj)


def test_stored_influences_are_sorted_and_normalised(rig):
    obj, armature, weights = rig
    write_weights(obj, armature, weights)
    stored = np.stack([read_attribute(obj.data, names.WEIGHT.format(slot)) for slot in range(4)], axis=1)
    assert (np.diff(stored, axis=1) <= 0).all()
    np.testing.assert_allclose(stored.sum(axis=1), 1.0, atol=1e-6)


def test_speed_of_a_hundred_thousand_splats(rng):
    """Guards against a hang only; the seconds are in `benchmarks/bench_scene_weights.py` and docs/benchmarks.md."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    cloud = clouds.random_cloud(100_000, 0)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(50, rng)
    weights = rigs.random_weights(cloud, 50, rng)
    began = time.process_time()
    write_weights(obj, armature, weights)
    assert time.process_time() - began < 60
    set_display(obj, "Display", False)
    rigs.random_pose(armature, rng)
    cost = rigs.pose_change_cost(armature, "bone.020")
    print(f"one pose change, 100,000 splats: {cost:.3f} s of processor time")
    assert cost < 5
    rigs.assert_same_pose(obj, armature)
