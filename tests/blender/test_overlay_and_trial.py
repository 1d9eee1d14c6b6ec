# SPDX-License-Identifier: GPL-3.0-or-later
"""What the display shows in place of colours, what moves with a splat, and Try It."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
import rig_scenes as rigs
from limb import make_limb

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.operators.moves_with import clicked_splat
from gskin_addon.scene import names, trial
from gskin_addon.scene.attributes import read_attribute, write_attribute
from gskin_addon.scene.display_inputs import DISPLAY_INPUTS, NATIVE
from gskin_addon.scene.node_groups import get_display, set_display
from gskin_addon.scene.overlay import OVERLAYS, overlay_of, set_overlay
from gskin_addon.scene.selecting import posed_points
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.steps import run_to_end
from gskin_addon.scene.trial import WIDEST, Player, Trial, iter_meter
from gskin_addon.scene.weights import write_weights

COUNT = 500


@pytest.fixture(scope="module")
def session():
    """A limb of three bones along x, with its true weights."""
    gskin_addon.register()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    limb = make_limb(COUNT)
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    parent = None
    for name, head, tail in zip(limb.skeleton.names, limb.skeleton.heads, limb.skeleton.tails, strict=True):
        bone = armature.data.edit_bones.new(name)
        bone.head, bone.tail, bone.parent = head, tail, parent
        parent = bone
    bpy.ops.object.mode_set(mode="OBJECT")
    obj = create_splat_object(limb.cloud, "S")
    yield obj, armature, limb.weights
    gskin_addon.unregister()


@pytest.fixture
def scene(session):
    obj, armature, weights = session
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    write_weights(obj, armature, weights, confidence=np.linspace(0, 1, COUNT))
    for bone in armature.pose.bones:
        bone.rotation_mode, bone.rotation_quaternion = "QUATERNION", (1, 0, 0, 0)
        for constraint in list(bone.constraints):
            bone.constraints.remove(constraint)
    set_overlay(obj, "NONE")
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    bpy.context.view_layer.update()
    return obj, armature


# --- overlays


def drawn_colors(obj):
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return read_attribute(evaluated.data, names.COLOR)


def test_one_choice_for_what_the_display_shows(scene):
    obj, _ = scene
    if NATIVE in DISPLAY_INPUTS:
        set_display(obj, NATIVE, False)  # its points have the colours elsewhere
    write_attribute(obj.data, names.STRETCH, "FLOAT", np.zeros(COUNT))
    write_attribute(obj.data, names.ALIKE, "FLOAT", np.ones(COUNT))
    seen = []
    obj.vertex_groups.active_index = 1
    for name, *_ in OVERLAYS:
        obj.gskin_overlay = name
        assert overlay_of(obj) == obj.gskin_overlay == name
        bpy.context.view_layer.update()
        seen.append(drawn_colors(obj))
    assert get_display(obj, "Show Weights Of") == names.STRETCH
    for one in range(len(seen)):
        for other in range(one):
            assert np.abs(seen[one] - seen[other]).max() > 0.1, (OVERLAYS[one][0], OVERLAYS[other][0])
    np.testing.assert_allclose(seen[4][:, :3], [[1, 0, 0]] * len(seen[4]), atol=1e-3)
    np.testing.assert_allclose(seen[5][:, :3], [[0, 0, 1]] * len(seen[5]), atol=1e-3)
    obj.gskin_overlay = "NONE"
    assert not get_display(obj, "Show Bones")
    assert not get_display(obj, "Show Confidence")
    assert get_display(obj, "Show Weights Of") == ""


def test_what_moves_with_a_splat(scene):
    obj, _ = scene
    at = read_cloud(obj).means[:, 0]
    tip = int(at.argmax())
    assert bpy.ops.gskin.show_moves_with(splat=tip) == {"FINISHED"}
    alike = read_attribute(obj.data, names.ALIKE)
    assert overlay_of(obj) == "ALIKE"
    np.testing.assert_allclose(alike[at > 2.2], 1, atol=1e-5)
    np.testing.assert_allclose(alike[at < 1.8], 0, atol=1e-5)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.gskin.select_by_bone(bone="bone0", least=0.99)
    assert bpy.ops.gskin.show_moves_with() == {"FINISHED"}
    assert obj.mode == "OBJECT", "there splats are seen"
    assert (read_attribute(obj.data, names.ALIKE)[at < 0.8] > 0.99).all()
    with pytest.raises(RuntimeError, match="the last is number 499"):
        bpy.ops.gskin.show_moves_with(splat=COUNT)


def test_a_click_finds_the_splat_that_is_seen(scene):
    obj, armature = scene
    armature.pose.bones["bone2"].rotation_quaternion = (0.7071, 0, 0, 0.7071)
    bpy.context.view_layer.update()
    points = posed_points(obj)
    np.testing.assert_allclose(points, rigs.posed_in_blender(obj)[0], atol=1e-5)
    matrix = np.diag([0.4, 0.4, -0.02, 1.0])  # orthographic, from +z
    base = read_attribute(obj.data, names.BASE)
    for wanted in (int(np.where(base[:, 3] >= 0.3, points[:, 2], -9).argmax()), 7):
        at = (points[wanted, :2] * 0.4 + 1) / 2 * (800, 600)
        found = clicked_splat(obj, matrix, tuple(at), (800, 600))
        assert points[found, 2] >= points[wanted, 2]
        assert np.linalg.norm((points[found, :2] - points[wanted, :2]) * 0.2 * (800, 600)) <= 10
    assert clicked_splat(obj, matrix, (5, 5), (800, 600)) is None


# --- Try It


def state(armature):
    return [
        (bone.name, tuple(bone.rotation_quaternion), tuple(bone.rotation_euler), tuple(map(tuple, bone.matrix_basis)),
         [(c.name, c.mute) for c in bone.constraints])
        for bone in armature.pose.bones
    ]  # fmt: skip


def test_good_weights_stretch_little_and_torn_ones_are_marked(scene):
    obj, armature = scene
    armature.pose.bones["bone1"].rotation_quaternion = (0.9, 0.1, 0.2, 0.3)
    before = state(armature)
    assert bpy.ops.gskin.try_it(beyond=4.0, most=100) == {"FINISHED"}
    assert state(armature) == before
    assert overlay_of(obj) == "STRETCH"
    assert not any(vertex.select for vertex in obj.data.vertices)
    # A patch of the first bone's that goes with the last one.
    at = read_cloud(obj).means
    patch = (np.abs(at[:, 0] - 0.4) < 0.12) & (at[:, 1] > 0)
    obj.vertex_groups["bone0"].remove(np.flatnonzero(patch).tolist())
    obj.vertex_groups["bone2"].add(np.flatnonzero(patch).tolist(), 1.0, "REPLACE")
    assert bpy.ops.gskin.try_it(beyond=4.0, most=100) == {"FINISHED"}
    marked = np.array([vertex.select for vertex in obj.data.vertices])
    assert marked[patch].mean() > 0.5
    assert marked[at[:, 0] > 1.0].sum() == 0
    stretch = read_attribute(obj.data, names.STRETCH)
    assert stretch[patch].mean() > 0.8 > 0.4 > stretch[at[:, 0] > 1.5].mean()
    assert state(armature) == before
    assert bpy.ops.gskin.try_it(beyond=1.0, most=2.0, again=True) == {"FINISHED"}
    assert sum(vertex.select for vertex in obj.data.vertices) == COUNT // 50


def test_ranges_come_from_limits_and_what_holds_bones_is_let_go(scene):
    obj, armature = scene
    bones = armature.pose.bones
    limit = bones["bone1"].constraints.new("LIMIT_ROTATION")
    limit.owner_space, limit.use_limit_x, limit.min_x, limit.max_x = "LOCAL", True, -0.2, 0.5
    limit.use_limit_z = True  # from 0 to 0: it does not turn there
    bones["bone2"].use_ik_limit_z, bones["bone2"].ik_min_z, bones["bone2"].ik_max_z = True, -1.0, 0.0
    bones["bone2"].lock_ik_x = True
    held = bones["bone2"].constraints.new("COPY_ROTATION")
    held.target, held.subtarget = armature, "bone0"
    bpy.context.view_layer.update()
    before, trial = state(armature), Trial(obj)
    found = {(name, axis): (low, high) for s in trial.swings for name, axis, low, high in s.bones}
    assert set(found) == {("bone1", 0), ("bone2", 2)}
    np.testing.assert_allclose(found["bone1", 0], (-0.2, 0.5), atol=1e-6)
    np.testing.assert_allclose(found["bone2", 2], (-1.0, 0.0), atol=1e-6)
    trial.begin()
    assert held.mute
    turned = {}
    for sample in trial.samples:
        trial.show(sample)
        if sample.is_end:
            name = sample.swing.bones[0][0]
            turned[name, sample.reach > 0] = bones[name].matrix_basis.to_quaternion().angle
    assert turned["bone1", True] == pytest.approx(0.5, abs=1e-5)
    assert turned["bone1", False] == pytest.approx(0.2, abs=1e-5)
    assert turned["bone2", False] == pytest.approx(1.0, abs=1e-5)
    trial.end()
    assert state(armature) == before
    bones["bone2"].use_ik_limit_z = bones["bone2"].lock_ik_x = False
    assert all(r[2:] == (-WIDEST, WIDEST) for s in Trial(obj).swings for r in s.bones if r[0] == "bone2")


def test_bones_that_constraints_hold_are_tried_though_their_channels_are_locked(scene):
    """So are all deform bones of Rigify."""
    obj, armature = scene
    bone = armature.pose.bones["bone2"]
    bone.lock_rotation = (True, True, True)
    assert not any(name == "bone2" for swing in Trial(obj).swings for name, *_ in swing.bones)
    bone.constraints.new("COPY_ROTATION").target = armature
    bone.constraints[0].subtarget = "bone0"
    tried = Trial(obj)
    assert {axis for swing in tried.swings for name, axis, *_ in swing.bones if name == "bone2"} == {0, 2}
    bone.lock_rotation = (False, False, False)


def test_played_in_time_with_every_end_and_stopped_at_any_moment(scene):
    obj, armature = scene
    before, trial = state(armature), Trial(obj)
    shown, measured = [], []
    show, measure = trial.show, trial.measure
    trial.show = lambda sample: (shown.append(sample), show(sample))
    trial.measure = lambda *work: (measured.append(work[0]), measure(*work))
    trial.begin()
    player, elapsed = Player(trial, 10.0), 0.0
    while player.step(elapsed):
        elapsed += 1.7  # a machine that shows few pictures
        time.sleep(0.002)
    trial.end()
    assert sorted(measured) == sorted(2 * [*range(len(trial.swings))])
    assert [s for s in shown if s.is_end] == [s for s in trial.samples if s.is_end]
    assert len(shown) < len(trial.samples)
    assert state(armature) == before
    at_once = Trial(obj)
    assert list(at_once.run())[-1] == 1.0
    np.testing.assert_allclose(at_once.stretch, trial.stretch, atol=1e-5)
    again = Trial(obj)
    again.begin()
    Player(again, 10.0).step(1.0)
    assert state(armature) != before
    again.end()
    assert state(armature) == before


def test_what_a_trial_needs_is_made_beside_blender(scene, monkeypatch):
    obj, threads, make = scene[0], [], trial.StretchMeter

    def noted(*args):
        threads.append(threading.current_thread())
        return make(*args)

    monkeypatch.setattr(trial, "StretchMeter", noted)
    meter = run_to_end(iter_meter(obj))
    assert len(threads) == 1
    assert threads[0] is not threading.main_thread()
    assert Trial(obj, meter).meter is meter
    assert len(threads) == 1, "it is not made again"
