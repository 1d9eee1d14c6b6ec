# SPDX-License-Identifier: GPL-3.0-or-later
"""Test Poses to Pose Library: what Try It plays, as pose assets of Blender's."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
from limb import make_limb

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.errors import InputError
from gskin_addon.operators import try_it
from gskin_addon.scene.asset_catalog import FILE, ensure_catalog
from gskin_addon.scene.pose_assets import poses_of, read_pose
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.trial import Trial
from gskin_addon.scene.weights import write_weights

COUNT = 400
BONES = ("bone0", "arm.L", "arm.R")


@pytest.fixture(scope="module")
def session():
    gskin_addon.register()
    yield
    gskin_addon.unregister()


@pytest.fixture
def scene(session):
    """Splats on three bones along x; the first is the root."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    limb = make_limb(COUNT)
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    parent = None
    for name, head, tail in zip(BONES, limb.skeleton.heads, limb.skeleton.tails, strict=True):
        bone = armature.data.edit_bones.new(name)
        bone.head, bone.tail, bone.parent = head, tail, parent
        parent = bone
    bpy.ops.object.mode_set(mode="OBJECT")
    obj = create_splat_object(limb.cloud, "S")
    write_weights(obj, armature, limb.weights)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    bpy.context.view_layer.update()
    return obj, armature


def assets():
    return {action.name: action for action in bpy.data.actions if action.asset_data is not None}


def rest(armature):
    for bone in armature.pose.bones:
        bone.matrix_basis.identity()
        bone.rotation_quaternion, bone.rotation_euler = (1, 0, 0, 0), (0, 0, 0)
    bpy.context.view_layer.update()


def apply(armature, action, **how):
    """As a click in Blender's pose library does; its operators need a window."""
    armature.pose.apply_pose_from_action(action, **how)
    bpy.context.view_layer.update()


def test_an_applied_pose_moves_the_splats_as_try_it_does(scene):
    obj, armature = scene
    armature.pose.bones["arm.R"].rotation_mode = "XYZ"
    armature.pose.bones["arm.L"].use_ik_limit_x = True
    armature.pose.bones["arm.L"].ik_min_x, armature.pose.bones["arm.L"].ik_max_x = -0.2, 1.0
    assert bpy.ops.gskin.test_poses(previews=False) == {"FINISHED"}
    poses = {name: action for name, action in assets().items() if name != "Rest"}
    # Along x nothing moves to the left or the right.
    assert set(poses) == {f"{b} {way}" for b in BONES[1:] for way in ("Up", "Down", "Forward", "Back")}
    moved = {}
    for name, action in poses.items():
        rest(armature)
        apply(armature, action)
        moved[name] = rigs.posed_in_blender(obj)[0]
        rigs.assert_same_pose(obj, armature)
    apply(armature, assets()["Rest"])
    still = rigs.posed_in_blender(obj)[0]
    np.testing.assert_allclose(still, rigs.posed_in_blender(obj)[0], atol=1e-6)
    trial = Trial(obj)
    trial.begin()
    ends = []
    for sample in trial.samples:
        if sample.is_end:
            trial.show(sample)
            ends.append(rigs.posed_in_blender(obj)[0])
    trial.end()
    assert len(ends) == len(poses)
    tip = still[:, 0].argmax()
    for name, points in moved.items():
        assert min(np.abs(points - end).max() for end in ends) < 1e-5, name
        way = (points - still)[tip]
        axis, sign = {"Up": (2, 1), "Down": (2, -1), "Forward": (1, -1), "Back": (1, 1)}[name.split()[1]]
        assert way[axis] * sign == pytest.approx(np.abs(way[1:]).max()), name
        assert way[axis] * sign > 0.1, name
    rest(armature)
    apply(armature, poses["arm.L Up"])
    half = armature.pose.bones["arm.L"].rotation_quaternion.angle / 2
    rest(armature)
    armature.pose.blend_pose_from_action(poses["arm.L Up"], blend_factor=0.5)
    assert armature.pose.bones["arm.L"].rotation_quaternion.angle == pytest.approx(half, abs=1e-3)


def test_each_is_an_asset_with_words_and_a_picture_and_the_pose_is_left_alone(scene):
    obj, armature = scene
    bone = armature.pose.bones["arm.R"]
    bone.rotation_quaternion, bone.location = (0.9, 0.1, 0.2, 0.3), (0.1, 0.2, 0.3)
    before = [tuple(map(tuple, b.matrix_basis)) for b in armature.pose.bones]
    assert bpy.ops.gskin.test_poses() == {"FINISHED"}
    assert [tuple(map(tuple, b.matrix_basis)) for b in armature.pose.bones] == before
    assert all(modifier.show_viewport for modifier in obj.modifiers)
    pictures = []
    for name, action in assets().items():
        assert action.use_fake_user
        assert "Test Pose" in {tag.name for tag in action.asset_data.tags}
        assert tuple(action.preview.image_size) == (128, 128)
        pixels = np.zeros(128 * 128 * 4, np.float32)
        action.preview.image_pixels_float.foreach_get(pixels)
        pictures.append((name, pixels))
        first, last = action.frame_range
        assert first == last
        for curve_path, _ in read_pose(next(p for p in poses_of(armature) if p.action == action)):
            assert curve_path.endswith("rotation_quaternion")
    assert len(pictures) == 9
    for number, (name, pixels) in enumerate(pictures):
        drawn = np.abs(pixels.reshape(-1, 4)[:, :3] - 0.19).max(axis=1) > 0.05
        assert 0.005 < drawn.mean() < 0.6, name
        assert all(np.abs(pixels - other).max() > 0.05 for _, other in pictures[:number]), name


def test_again_it_replaces_its_own_and_leaves_others(scene):
    _, armature = scene
    own = bpy.data.actions.new("arm.L Up")
    own.asset_mark()
    assert bpy.ops.gskin.test_poses(previews=False) == {"FINISHED"}
    count = len(bpy.data.actions)
    used = assets()["arm.R Up"]
    armature.animation_data_create().action = used
    armature.name = "Renamed"
    armature.pose.bones["arm.L"].lock_rotation[0] = True
    assert bpy.ops.gskin.test_poses(previews=False) == {"FINISHED"}
    assert bpy.data.actions["arm.L Up"] == own
    assert own.asset_data is not None
    assert armature.animation_data.action == used
    assert used.asset_data is None
    assert len(bpy.data.actions) == count - 2 + 1, "two poses less, and the one in use"
    armature.animation_data.action = None
    other = bpy.data.objects.new("Other", armature.data.copy())
    bpy.context.scene.collection.objects.link(other)
    assert len(poses_of(armature)) == 7


def test_undo_takes_them_away_again(scene):
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.gskin.test_poses(previews=False) == {"FINISHED"}
    assert assets()
    bpy.ops.ed.undo_push(message="Test Poses")
    bpy.ops.ed.undo()
    assert not assets()
    bpy.ops.ed.redo()
    assert len(assets()) == 9


def test_try_it_plays_the_pose_library(scene):
    obj, armature = scene
    with pytest.raises(RuntimeError, match="no pose assets of 'Rig'"):
        bpy.ops.gskin.try_it(poses="LIBRARY")
    assert bpy.ops.gskin.test_poses(previews=False) == {"FINISHED"}
    crouch = bpy.data.actions["arm.L Up"].copy()
    crouch.name = "Crouch"
    crouch.asset_mark()
    for action in list(assets().values()):
        if action != crouch:
            action.asset_clear()
    armature.pose.bones["arm.L"].rotation_quaternion = (0.9, 0.1, 0.2, 0.3)
    before = [tuple(map(tuple, bone.matrix_basis)) for bone in armature.pose.bones]
    trial = Trial(obj, library=True)
    trial.begin()
    (end,) = [sample for sample in trial.samples if sample.is_end]
    trial.show(end)
    played = rigs.posed_in_blender(obj)[0]
    trial.show(trial.samples[0])
    half = rigs.posed_in_blender(obj)[0]
    trial.end()
    assert [tuple(map(tuple, bone.matrix_basis)) for bone in armature.pose.bones] == before
    assert np.abs(half - played).max() > 0.1
    apply(armature, crouch)
    np.testing.assert_allclose(rigs.posed_in_blender(obj)[0], played, atol=1e-5)
    assert bpy.ops.gskin.try_it(poses="LIBRARY", beyond=1.01, most=50) == {"FINISHED"}
    assert sum(vertex.select for vertex in obj.data.vertices) > 0
    assert try_it._last[obj.data.session_uid].to_blame(np.ones(COUNT, bool)) == ["Crouch"]


def test_a_bone_that_is_held_is_turned_by_its_control(scene):
    obj, armature = scene
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for name in BONES[1:]:
        source = armature.data.edit_bones[name]
        control = armature.data.edit_bones.new(f"control {name}")
        control.head, control.tail, control.roll, control.parent = source.head, source.tail, source.roll, source.parent
        control.use_deform = False
    bpy.ops.object.mode_set(mode="OBJECT")
    copied = armature.pose.bones["arm.L"].constraints.new("COPY_ROTATION")
    copied.target, copied.subtarget = armature, "control arm.L"
    driver = copied.driver_add("influence").driver
    variable = driver.variables.new()
    variable.targets[0].id, variable.targets[0].data_path = armature, 'pose.bones["bone0"]["follow"]'
    driver.expression = "var"
    armature.pose.bones["bone0"]["follow"] = 0.0
    held = armature.pose.bones["arm.R"].constraints.new("COPY_ROTATION")
    held.target = obj  # nothing that a bone could do about it
    bpy.context.view_layer.objects.active = obj
    armature.pose.bones["bone0"]["follow"] = 1.0
    armature.update_tag()
    bpy.context.view_layer.update()
    assert bpy.ops.gskin.test_poses(previews=False) == {"FINISHED"}
    assert {name.rsplit(" ", 1)[0] for name in assets()} == {"control arm.L", "Rest"}
    points = rigs.posed_in_blender(obj)[0]
    apply(armature, assets()["control arm.L Up"])
    now = rigs.posed_in_blender(obj)[0]
    tip = points[:, 0].argmax()
    assert now[tip, 2] - points[tip, 2] > 0.5
    assert 'pose.bones["arm.L"]' not in {path for path, _ in read_pose(poses_of(armature)[0])}
    apply(armature, assets()["Rest"])
    np.testing.assert_allclose(rigs.posed_in_blender(obj)[0], points, atol=1e-5)
    armature.pose.bones["arm.L"].constraints[0].target = obj
    count = len(bpy.data.actions)
    with pytest.raises(RuntimeError, match=r"nor a control of one: 'arm\.L', 'arm\.R'"):
        bpy.ops.gskin.test_poses(previews=False)
    assert len(bpy.data.actions) == count


def test_they_have_a_catalog_of_their_own_in_a_saved_file(scene, tmp_path):
    assert scene
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"))
    for _ in range(2):
        assert bpy.ops.gskin.test_poses(previews=False) == {"FINISHED"}
    lines = [line for line in (tmp_path / FILE).read_text().splitlines() if line and not line.startswith("#")]
    assert lines[0] == "VERSION 1"
    ident, path, simple = lines[1].split(":")
    assert (path, simple, len(lines)) == ("Test Poses/Rig", "Test Poses-Rig", 2)
    assert {action.asset_data.catalog_id for action in assets().values()} == {ident}
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "file.blend"))
    assert {action.asset_data.catalog_id for action in assets().values()} == {ident}
    assert len(poses_of(bpy.data.objects["Rig"])) == 9
    assert ensure_catalog(tmp_path, "Other/One: two") != ident
    assert ":Other/One- two:" in (tmp_path / FILE).read_text()
    (tmp_path / FILE).write_text("VERSION 9\n")
    with pytest.raises(InputError, match="begins with 'VERSION 9'"):
        ensure_catalog(tmp_path, "Other")
