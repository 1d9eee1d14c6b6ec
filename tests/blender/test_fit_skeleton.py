# SPDX-License-Identifier: GPL-3.0-or-later
"""Fit Human and Import Skeleton: armatures in the scene, where the splats are."""

from __future__ import annotations

import threading
from itertools import pairwise

import capsule_person as persons
import numpy as np
import pytest
from patience import HANG

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.skeleton.fit import fit
from gskin_addon.core.skeleton.placing import guess_placing
from gskin_addon.scene import import_skeleton
from gskin_addon.scene.armature import read_skeleton
from gskin_addon.scene.fitted_rig import create_armature, create_fitted_rig, rigify_is_on
from gskin_addon.scene.landmarks import read_landmarks
from gskin_addon.scene.rig_fit import move_rig
from gskin_addon.scene.splat_object import create_splat_object, read_cloud

DIAGONAL = 2.1


@pytest.fixture(scope="module", autouse=True)
def registered():
    gskin_addon.register()
    yield
    gskin_addon.unregister()


@pytest.fixture
def splats():
    """A person who stands beside the origin, turned by a right angle, and is chosen."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    obj = create_splat_object(persons.person(5000), "Person")
    obj.location, obj.rotation_euler = (2, 1, 0.5), (0, 0, np.pi / 2)
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj
    bpy.context.view_layer.update()
    return obj


def joint_errors(armature, splats):
    matrix = np.array(splats.matrix_world)
    heads = {b.name: np.array(armature.matrix_world @ b.head_local) for b in armature.data.bones}
    bones = {"hips": "spine", "neck": "spine.004", "shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand",
             "thigh": "thigh", "knee": "shin", "ankle": "foot", "toe": "toe"}  # fmt: skip
    errors = []
    for name, place in persons.joints().items():
        joint, _, side = name.partition(".")
        if joint in bones:
            bone = f"{bones[joint]}.{side}" if side else bones[joint]
            errors.append(np.linalg.norm(heads[bone] - matrix[:3, :3] @ place - matrix[:3, 3]))
    return np.array(errors)


@pytest.mark.parametrize("rigify", [False, True])
def test_fit_human_makes_an_armature_in_the_splats(splats, rigify):
    assert bpy.ops.gskin.fit_human(rigify=rigify) == {"FINISHED"}
    armature = bpy.context.active_object
    assert armature.type == "ARMATURE"
    assert joint_errors(armature, splats).mean() < 0.04 * DIAGONAL
    assert (splats.select_get(), armature.select_get(), armature.mode) == (True, True, "OBJECT")
    # Blender mirrors along the armature's own x: its bones are mirror images there, by name.
    assert armature.data.use_mirror_x
    assert armature.pose.use_mirror_x
    bones = armature.data.bones
    for bone in bones:
        if bone.name.endswith(".L"):
            twin = bones[f"{bone.name[:-1]}R"]
            np.testing.assert_allclose(np.array(twin.head_local) * [-1, 1, 1], bone.head_local, atol=1e-5)
    assert not bones["heel.02.L"].use_deform
    assert bones["forearm.L"].use_deform
    assert bones["forearm.L"].use_connect
    read_skeleton(armature).validate()
    rigged = [bone.rigify_type for bone in armature.pose.bones] if rigify_is_on() else []
    assert ("limbs.arm" in rigged) is rigify
    if rigify:
        bpy.ops.preferences.addon_disable(module="rigify")


def test_a_pose_of_one_arm_is_mirrored_to_the_other(splats):
    assert bpy.ops.gskin.fit_human(rigify=False) == {"FINISHED"}
    armature = bpy.context.active_object
    bpy.ops.object.mode_set(mode="EDIT")
    edit = armature.data.edit_bones
    for bone in edit:
        bone.select = bone.select_head = bone.select_tail = False
    edit["forearm.L"].select_tail = edit["hand.L"].select_head = True
    before = edit["forearm.R"].tail.copy()
    bpy.ops.transform.translate(value=(0, 0, 0.1))
    after = edit["forearm.R"].tail.copy()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert after.z - before.z == pytest.approx(0.1, abs=1e-4)


def test_landmarks_are_marked_at_the_cursor_and_at_selected_splats(splats):
    bpy.context.scene.cursor.location = (2.5, 1.0, 1.5)
    assert bpy.ops.gskin.mark_landmark(name="hand.L") == {"FINISHED"}
    bpy.ops.object.select_all(action="DESELECT")
    splats.select_set(True)
    bpy.context.view_layer.objects.active = splats
    top = np.zeros(len(splats.data.vertices), bool)
    top[read_cloud(splats).means[:, 2].argmax()] = True
    splats.data.vertices.foreach_set("select", top)
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.gskin.mark_landmark(name="head") == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    marks = read_landmarks(splats)
    np.testing.assert_allclose(marks["hand.L"], [2.5, 1.0, 1.5], atol=1e-5)
    np.testing.assert_allclose(marks["head"], read_cloud(splats).means[top][0], atol=1e-4)
    # The empties move with the splats, and a second mark moves the first.
    splats.location.x += 1
    bpy.context.view_layer.update()
    np.testing.assert_allclose(read_landmarks(splats)["hand.L"], [3.5, 1.0, 1.5], atol=1e-5)
    bpy.context.scene.cursor.location = (3.4, 1.0, 1.6)
    assert bpy.ops.gskin.mark_landmark(name="hand.L") == {"FINISHED"}
    assert len(read_landmarks(splats)) == 2
    assert bpy.ops.gskin.fit_human(rigify=False) == {"FINISHED"}
    hand = bpy.context.active_object.data.bones["hand.L"]
    tip = np.array(bpy.context.active_object.matrix_world @ hand.tail_local)
    assert np.linalg.norm(tip - [3.4, 1.0, 1.6]) < 0.2
    assert bpy.ops.gskin.clear_landmarks() == {"FINISHED"}
    assert not read_landmarks(splats)


def test_a_skeleton_of_another_program_is_turned_and_scaled_into_the_splats(splats, tmp_path):
    """Its axes have y up and its unit is the centimetre."""
    matrix = np.array(splats.matrix_world)
    lines = []
    for name, place in persons.joints().items():
        x, y, z = 100 * (matrix[:3, :3] @ place + matrix[:3, 3])
        lines.append(f"joints {name} {x} {z} {-y}")
    chain = ["hips neck", "neck head"]
    for side in "LR":
        for limb in (("neck", "shoulder", "elbow", "wrist"), ("hips", "thigh", "knee", "ankle", "toe")):
            named = [limb[0], *(f"{joint}.{side}" for joint in limb[1:])]
            chain += [f"{a} {b}" for a, b in pairwise(named)]
    path = tmp_path / "person.txt"
    path.write_text("\n".join([*lines, "root hips", *(f"hier {pair}" for pair in chain)]))
    assert bpy.ops.gskin.import_skeleton(filepath=str(path)) == {"FINISHED"}
    armature = bpy.context.active_object
    knee = np.array(armature.matrix_world @ armature.data.bones["knee.L"].head_local)
    expected = matrix[:3, :3] @ persons.joints()["knee.L"] + matrix[:3, 3]
    assert np.linalg.norm(knee - expected) < 0.03 * DIAGONAL


def test_a_character_file_is_brought_into_the_splats(splats, tmp_path):
    """A .vrm is a .glb by another name; here it is a tenth of the size and lies elsewhere."""
    found = fit("human", read_cloud(splats))
    armature = create_armature(found.placed().moved(np.eye(3), 0.1, (4, 0, 0)), "Avatar")
    bpy.ops.object.select_all(action="DESELECT")
    armature.select_set(True)
    path = tmp_path / "avatar.glb"
    bpy.ops.export_scene.gltf(filepath=str(path), use_selection=True)
    path.rename(path.with_suffix(".vrm"))
    bpy.data.objects.remove(armature)
    splats.select_set(True)
    bpy.context.view_layer.objects.active = splats
    assert bpy.ops.gskin.import_skeleton(filepath=str(path.with_suffix(".vrm"))) == {"FINISHED"}
    armature = bpy.context.active_object
    assert joint_errors(armature, splats).mean() < 0.06 * DIAGONAL


def test_importing_a_skeleton_left_at_once_or_half_way_adds_nothing(splats, tmp_path, monkeypatch):
    """Its place is looked for beside Blender, which goes on meanwhile; Escape closes the steps."""
    armature = create_armature(fit("human", read_cloud(splats)).placed().moved(np.eye(3), 0.1, (4, 0, 0)), "Avatar")
    bpy.ops.object.select_all(action="DESELECT")
    armature.select_set(True)
    glb, text = tmp_path / "avatar.glb", tmp_path / "joints.txt"
    bpy.ops.export_scene.gltf(filepath=str(glb), use_selection=True)
    text.write_text("joints a 0 0 0\njoints b 0 0 9\nroot a\nhier a b")
    bpy.data.batch_remove([armature.data, armature])
    before, threads, hold = set(bpy.data.user_map()), [], threading.Event()

    def slow(skeleton, points):
        threads.append(threading.current_thread())
        hold.wait(HANG)
        return guess_placing(skeleton, points)

    monkeypatch.setattr(import_skeleton, "guess_placing", slow)
    for path in (glb, text):
        steps = import_skeleton.iter_import_skeleton(path, splats)
        shares = [next(steps) for _ in range(8)]
        assert shares == sorted(shares)
        assert shares[-1] < 1
        steps.close()
        assert set(bpy.data.user_map()) == before, path
    assert len(threads) == 2
    assert threading.main_thread() not in threads
    hold.set()
    for thread in threads:
        thread.join(HANG)


@pytest.mark.parametrize("kind", ["action", "nla", "driver"])
def test_a_rig_that_is_animated_as_an_object_stays_where_it_was_brought(splats, kind, tmp_path):
    """As exporters write it: keys of the object's place would put it back at the next frame."""
    found = fit("human", read_cloud(splats))
    armature = create_armature(found.placed().moved(np.eye(3), 0.1, (4, 0, 0)), "Walker")
    step = bpy.data.objects.new("Target", None)
    bpy.context.scene.collection.objects.link(step)
    step.location = armature.matrix_world @ armature.data.bones["hand.L"].tail_local
    armature.pose.bones["hand.L"].constraints.new("DAMPED_TRACK").target = step
    if kind == "driver":
        armature.driver_add("location", 0).driver.expression = "0"
    else:
        for path in ("location", "rotation_euler", "scale"):
            armature.keyframe_insert(path, frame=1)
    if kind == "nla":
        data = armature.animation_data
        track, action, slot = data.nla_tracks.new(), data.action, getattr(data, "action_slot", None)
        strip = track.strips.new("walk", 1, action)
        data.action = None
        if slot is not None:
            strip.action_slot = slot
    path = tmp_path / "walker.blend"
    bpy.data.libraries.write(str(path), {armature, step}, fake_user=True)
    bpy.data.objects.remove(armature)
    bpy.data.objects.remove(step)
    splats.select_set(True)
    bpy.context.view_layer.objects.active = splats
    assert bpy.ops.gskin.import_skeleton(filepath=str(path)) == {"FINISHED"}
    armature = bpy.context.active_object
    bpy.context.scene.frame_set(5)
    assert joint_errors(armature, splats).mean() < 0.06 * DIAGONAL
    target = armature.pose.bones["hand.L"].constraints[0].target
    tip = armature.matrix_world @ armature.data.bones["hand.L"].tail_local
    assert (target.matrix_world.translation - tip).length < 1e-3
    moved = np.array(armature.matrix_world.translation)
    move_rig(armature, np.array([1.0, 0.0, 0.0]))
    bpy.context.scene.frame_set(6)
    np.testing.assert_allclose(np.array(armature.matrix_world.translation) - moved, [1, 0, 0], atol=1e-5)


def test_the_metarig_becomes_a_control_rig_in_the_splats(splats):
    """Rigify would put it at the world's origin."""
    assert bpy.ops.gskin.fit_human() == {"FINISHED"}
    try:
        metarig = bpy.context.active_object
        assert [obj.name for obj in bpy.context.scene.objects if obj.type == "ARMATURE"] == [metarig.name]
        assert bpy.ops.pose.rigify_generate() == {"FINISHED"}
        bpy.context.view_layer.update()
        rig = metarig.data.rigify_target_rig
        assert rig.name in bpy.context.scene.objects
        for name in ("forearm.L", "shin.R", "spine.003"):
            here = rig.matrix_world @ rig.data.bones[f"DEF-{name}"].head_local
            there = metarig.matrix_world @ metarig.data.bones[name].head_local
            np.testing.assert_allclose(here, there, atol=1e-4)
        quadruped = create_fitted_rig(fit("quadruped", read_cloud(splats)), "Beast")
        kinds = {bone.name: bone.rigify_type for bone in quadruped.pose.bones}
        assert kinds["front_thigh.L"] == "limbs.front_paw"
        assert kinds["spine.004"] == "spines.basic_spine"
    finally:
        bpy.ops.preferences.addon_disable(module="rigify")
