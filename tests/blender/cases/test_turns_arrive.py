# SPDX-License-Identifier: GPL-3.0-or-later
"""A pose that does not arrive at the splats is never reported as done; one that arrives stays in the file."""

from __future__ import annotations

import bpy
import figure_rig as fig
import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.ply import read_ply
from gskin_addon.scene.posing import turn_bones

REST = fig.cloud().means


def rest_position(splats, armature):
    armature.data.pose_position = "REST"


def excluded(splats, armature):
    fig.move_to_collection([splats, armature])
    bpy.context.view_layer.layer_collection.children["Hidden"].exclude = True


def hidden_in_layer(splats, armature):
    fig.move_to_collection([splats, armature])
    bpy.context.view_layer.layer_collection.children["Hidden"].hide_viewport = True


def switched_off_collection(splats, armature):
    fig.move_to_collection([armature]).hide_viewport = True
    armature.location = (0.0, 0.0, 0.0)


def disabled(splats, armature):
    splats.hide_viewport = armature.hide_viewport = True
    splats.hide_render = armature.hide_render = True


def eye(splats, armature):
    splats.hide_set(True)
    armature.hide_set(True)


def in_another_scene(splats, armature):
    bpy.context.scene.collection.objects.unlink(armature)
    bpy.data.scenes.new("Other").collection.objects.link(armature)


def unselectable(splats, armature):
    splats.hide_select = armature.hide_select = True


def euler(splats, armature):
    armature.pose.bones["arm.L"].rotation_mode = "ZXY"


def axis_angle(splats, armature):
    armature.pose.bones["arm.L"].rotation_mode = "AXIS_ANGLE"


def locked(splats, armature):
    bone = armature.pose.bones["arm.L"]
    bone.lock_rotation = (True, True, True)
    bone.lock_rotation_w = True


def muted_constraint(splats, armature):
    constraint = armature.pose.bones["arm.L"].constraints.new("COPY_ROTATION")
    constraint.target, constraint.mute = fig.add_empty("target"), True


def moved_and_excluded(splats, armature):
    """Of what is not evaluated, not even the place in the world is known after loading."""
    armature.location = (1.0, 2.0, 3.0)
    excluded(splats, armature)


ARRIVE = [
    rest_position, excluded, hidden_in_layer, switched_off_collection, disabled, eye, in_another_scene, unselectable,
    euler, axis_angle, locked, muted_constraint,
]  # fmt: skip


@pytest.mark.parametrize("change", ARRIVE, ids=lambda f: f.__name__)
def test_the_turn_arrives_and_stays(change, tmp_path):
    source = fig.rigged(tmp_path / "in.blend", change)
    np.testing.assert_allclose(fig.posed_means(source, *fig.TURN), fig.expected(REST), atol=1e-5)
    assert fig.run("pose", source, "--out", tmp_path / "out.blend", *fig.TURN) == 0
    np.testing.assert_allclose(fig.posed_means(tmp_path / "out.blend"), fig.expected(REST), atol=1e-5)


def test_switches_of_the_file_are_kept(tmp_path):
    source = fig.rigged(tmp_path / "in.blend", disabled)
    assert fig.run("pose", source, "--out", tmp_path / "out.blend", *fig.TURN) == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out.blend"))
    obj = bpy.data.objects["Rig"]
    assert obj.hide_viewport
    assert obj.hide_render
    assert [collection.name for collection in obj.users_collection] == ["Scene Collection"]


def test_what_is_not_evaluated_is_where_it_belongs(tmp_path):
    shift = np.array([1.0, 2.0, 3.0])
    source = fig.rigged(tmp_path / "in.blend", moved_and_excluded)
    np.testing.assert_allclose(fig.posed_means(source), REST + shift, atol=1e-5)
    np.testing.assert_allclose(fig.posed_means(source, *fig.TURN), fig.expected(REST) + shift, atol=1e-5)


def test_rotation_modes_stay(tmp_path):
    fig.rigged(tmp_path / "in.blend", euler)
    armature = bpy.data.objects["Rig"]
    turn_bones(armature, {"arm.L": (0, -60, 0)})
    assert armature.pose.bones["arm.L"].rotation_mode == "ZXY"


def held_by_constraint(splats, armature):
    constraint = armature.pose.bones["arm.L"].constraints.new("COPY_ROTATION")
    constraint.target = fig.add_empty("target")


def held_by_tracking(splats, armature):
    constraint = armature.pose.bones["arm.L"].constraints.new("DAMPED_TRACK")
    constraint.target = fig.add_empty("target", (0.5, 0.0, 2.0))


def held_by_ik(splats, armature):
    constraint = armature.pose.bones["hand.L"].constraints.new("IK")
    constraint.target, constraint.chain_count = fig.add_empty("target", (0.6, 0.0, 1.25)), 2
    constraint.pole_target = fig.add_empty("pole", (0.3, -1.0, 1.6))


def driven(splats, armature):
    owner = fig.add_empty("target")
    owner["turn"] = 0.3
    bone = armature.pose.bones["arm.L"]
    bone.rotation_mode = "XYZ"
    for curve in bone.driver_add("rotation_euler"):
        variable = curve.driver.variables.new()
        variable.targets[0].id, variable.targets[0].data_path = owner, '["turn"]'
        curve.driver.expression = variable.name


@pytest.mark.parametrize("change", [held_by_constraint, held_by_tracking, held_by_ik, driven], ids=lambda f: f.__name__)
def test_a_turn_that_cannot_arrive_is_refused_with_what_to_move(change, tmp_path, capfd):
    source = fig.rigged(tmp_path / "in.blend", change)
    before = source.read_bytes()
    for kind in ("ply", "blend"):
        assert fig.run("pose", source, "--out", tmp_path / f"out.{kind}", *fig.TURN) == 2
        assert not (tmp_path / f"out.{kind}").exists()
        error = capfd.readouterr().err
        assert "'arm.L' of 'Rig' cannot be turned" in error
        assert "'target'" in error
    assert source.read_bytes() == before


def test_pictures_and_glb_are_refused_too(tmp_path):
    source = fig.rigged(tmp_path / "in.blend", held_by_constraint)
    assert fig.run("render", source, "--out", tmp_path / "out.png", *fig.TURN) == 2
    assert fig.run("pose", source, "--out", tmp_path / "out.glb", *fig.TURN) == 2


def test_a_turn_that_arrives_in_part_says_so(tmp_path, capfd):
    def limited(splats, armature):
        constraint = armature.pose.bones["arm.L"].constraints.new("LIMIT_ROTATION")
        constraint.owner_space, constraint.use_limit_x = "LOCAL", True
        constraint.min_x, constraint.max_x = -0.5, 0.5

    source = fig.rigged(tmp_path / "in.blend", limited)
    assert fig.run("pose", source, "--out", tmp_path / "out.ply", *fig.TURN) == 0
    assert "'arm.L' turned by 29 of 60 degrees" in capfd.readouterr().err
    assert np.abs(read_ply(tmp_path / "out.ply").cloud.means - REST).max() > 0.1


def test_a_bone_that_moves_no_splats_is_refused_beside_none_that_does(tmp_path, capfd):
    def prop(splats, armature):
        bpy.context.view_layer.objects.active = armature
        bpy.ops.object.mode_set(mode="EDIT")
        bone = armature.data.edit_bones.new("prop")
        bone.head, bone.tail, bone.use_deform = (1, 0, 0), (1, 0, 1), False
        bpy.ops.object.mode_set(mode="OBJECT")

    source = fig.rigged(tmp_path / "in.blend", prop)
    assert fig.run("pose", source, "--out", tmp_path / "out.ply", "--rotate", "prop", 0, 30, 0) == 2
    assert "'prop' of 'Rig' moves no splats of 'fig'" in capfd.readouterr().err
    assert fig.run("pose", source, "--out", tmp_path / "out.ply", "--rotate", "prop", 0, 30, 0, *fig.TURN) == 0
    assert "'prop' of 'Rig' moves no splats of 'fig'" in capfd.readouterr().err


def test_a_control_and_its_switch_are_found(tmp_path, capfd):
    """A deform bone that follows either of two controls, as Rigify's limbs do; the switch is on the other one."""

    def switched(splats, armature):
        bpy.context.view_layer.objects.active = armature
        bpy.ops.object.mode_set(mode="EDIT")
        for name in ("arm_fk.L", "arm_ik.L"):
            bone, like = armature.data.edit_bones.new(name), armature.data.edit_bones["arm.L"]
            bone.head, bone.tail, bone.roll, bone.use_deform = like.head, like.tail, like.roll, False
            bone.parent = like.parent
        bpy.ops.object.mode_set(mode="OBJECT")
        bones = armature.pose.bones
        bones["spine"]["IK_FK"] = 0.0
        still = bones["arm_ik.L"].constraints.new("LIMIT_ROTATION")
        still.use_limit_x = still.use_limit_y = still.use_limit_z = True
        still.owner_space = "LOCAL"
        for name, expression in (("arm_fk.L", "var"), ("arm_ik.L", "1-var")):
            constraint = bones["arm.L"].constraints.new("COPY_ROTATION")
            constraint.target, constraint.subtarget = armature, name
            driver = constraint.driver_add("influence").driver
            variable = driver.variables.new()
            variable.name = "var"
            variable.targets[0].id, variable.targets[0].data_path = armature, 'pose.bones["spine"]["IK_FK"]'
            driver.expression = expression

    source = fig.rigged(tmp_path / "in.blend", switched)
    out = tmp_path / "out.ply"
    assert fig.run("pose", source, "--out", out, *fig.TURN) == 2
    assert "turn 'arm_fk.L' instead, after setting 'IK_FK' of 'spine' to 1" in capfd.readouterr().err
    control = ("--rotate", "arm_fk.L", 0, -60, 0)
    assert fig.run("pose", source, "--out", out, *control) == 2
    assert "moves no splats of 'fig'; set 'IK_FK' of 'spine' to 1 first" in capfd.readouterr().err
    means = fig.posed_means(source, "--set", "spine", "IK_FK", 1, *control)
    np.testing.assert_allclose(means, fig.expected(REST), atol=1e-5)
    assert fig.run("pose", source, "--out", out, "--set", "spine", "FK", 1) == 2
    assert "Bone 'spine' has no number 'FK' among its custom properties; it has 'IK_FK'" in capfd.readouterr().err


def test_refused_turns_leave_the_bones_as_they_were(tmp_path):
    fig.rigged(tmp_path / "in.blend", held_by_ik)
    armature = bpy.data.objects["Rig"]
    before = {bone.name: tuple(bone.rotation_quaternion) for bone in armature.pose.bones}
    with pytest.raises(InputError, match="cannot be turned"):
        turn_bones(armature, {"head": (0, 20, 0), "arm.L": (0, -60, 0)})
    assert {bone.name: tuple(bone.rotation_quaternion) for bone in armature.pose.bones} == before


def nla(splats, armature):
    action = fig.wave(armature, "Idle")
    data = armature.animation_data
    data.action = None
    track = data.nla_tracks.new()
    track.name = "Idle"
    strip = track.strips.new("Idle", 1, action)
    if hasattr(strip, "action_slot") and strip.action_slot is None:
        strip.action_slot = action.slots[0]
    bpy.context.scene.frame_set(1)


def two_tracks(splats, armature):
    nla(splats, armature)
    action = bpy.data.actions["Idle"]
    track = armature.animation_data.nla_tracks.new()
    track.name = "More"
    track.strips.new("More", 1, action).blend_type = "ADD"


def active_action(splats, armature):
    fig.wave(armature, "Idle")
    bpy.context.scene.frame_set(1)


def tweaked(splats, armature):
    nla(splats, armature)
    data = armature.animation_data
    data.nla_tracks[0].select = True
    data.nla_tracks[0].strips[0].select = True
    data.nla_tracks.active = data.nla_tracks[0]
    data.use_tweak_mode = True
    assert data.use_tweak_mode


@pytest.mark.parametrize("change", [nla, two_tracks, active_action, tweaked], ids=lambda f: f.__name__)
def test_animation_does_not_take_the_pose_back(change, tmp_path, capfd):
    source = fig.rigged(tmp_path / "in.blend", change)
    out = tmp_path / "out.blend"
    assert fig.run("pose", source, "--out", out, *fig.TURN) == 0
    assert "so that the pose stays" in capfd.readouterr().err
    np.testing.assert_allclose(fig.posed_means(out), fig.expected(REST), atol=1e-5)
    bpy.ops.wm.open_mainfile(filepath=str(out))
    assert "Idle" in bpy.data.actions  # it is taken off, not away
    bpy.context.scene.frame_set(5)
    np.testing.assert_allclose(fig.posed_means(out), fig.expected(REST), atol=1e-5)


@pytest.mark.parametrize("how", ["linked", "override"])
def test_the_pose_of_a_rig_from_a_library_is_kept(how, tmp_path):
    fig.empty()
    fig.move_to_collection([fig.add_rig()], "Char")
    fig.save(tmp_path / "char.blend")
    fig.empty()
    with bpy.data.libraries.load(str(tmp_path / "char.blend"), link=True) as (_, target):
        target.collections = ["Char"]
    (collection,) = target.collections
    bpy.context.scene.collection.children.link(collection)
    bpy.context.view_layer.update()
    if how == "override":
        collection.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer, do_fully_editable=True)
        bpy.context.scene.collection.children.unlink(collection)
    fig.add_splats(next(obj for obj in bpy.context.scene.objects if obj.type == "ARMATURE"))
    fig.save(tmp_path / "in.blend")
    np.testing.assert_allclose(fig.posed_means(tmp_path / "in.blend", *fig.TURN), fig.expected(REST), atol=1e-5)
    assert fig.run("pose", tmp_path / "in.blend", "--out", tmp_path / "out.blend", *fig.TURN) == 0
    np.testing.assert_allclose(fig.posed_means(tmp_path / "out.blend"), fig.expected(REST), atol=1e-5)


def test_a_rig_at_rest_is_said_to_be(tmp_path, capfd):
    source = fig.rigged(tmp_path / "in.blend", rest_position)
    assert fig.run("pose", source, "--out", tmp_path / "out.ply") == 0
    assert "Armature 'Rig' is in Rest Position, and its splats with it." in capfd.readouterr().err


def test_a_frame_of_nothing_says_so(tmp_path, capfd):
    source = fig.rigged(tmp_path / "in.blend")
    assert fig.run("pose", source, "--out", tmp_path / "out.ply", "--frame", 7) == 0
    assert "Nothing moves 'Rig': it is the same at every frame." in capfd.readouterr().err
