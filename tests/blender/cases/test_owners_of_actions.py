# SPDX-License-Identifier: GPL-3.0-or-later
"""An action, or a slot of it, belongs to somebody: another's is neither applied nor exported."""

from __future__ import annotations

import bpy
import figure_rig as fig
import numpy as np
import pytest
from glb import Glb

from gskin_addon.core.errors import InputError
from gskin_addon.scene import actions, gltf_export, rig_files
from gskin_addon.scene.actions import Part, belongs, choose_part, own_parts, parts_of
from gskin_addon.scene.gltf_export import export_glb

SLOTS = hasattr(bpy.types, "ActionSlot")


def slotted(armature, other, first: str = "other"):
    """One action 'Attack' with a slot for each; the other's comes first, and turns the arm the other way."""
    action = fig.wave(other if first == "other" else armature, "Attack", -0.5 if first == "other" else 1.0)
    second = armature if first == "other" else other
    data = second.animation_data_create()
    data.action = action
    data.action_slot = action.slots.new("OBJECT", second.name)
    bone = second.pose.bones["arm.L"]
    angle = 1.0 if second == armature else -0.5
    for frame, value in {1: (1, 0, 0, 0), 10: (np.cos(angle / 2), np.sin(angle / 2), 0, 0)}.items():
        bone.rotation_quaternion = value
        bone.keyframe_insert("rotation_quaternion", frame=frame)
    return action


def two(path, change):
    """A file with 'Hero', which moves the figure, and 'Monster', after change(hero, monster); how it is posed then."""
    _, hero = fig.open_base()
    hero.name = "Hero"
    monster = fig.add_rig("Monster")
    camera = bpy.data.objects.new("Cam", bpy.data.cameras.new("Cam"))
    bpy.context.scene.collection.objects.link(camera)
    fig.key(camera, "location", {1: (0, -3, 1), 30: (0, -2, 1)}, name="CameraMove")
    change(hero, monster)
    fig.save(path)
    return path


def clips(hero, monster):
    fig.wave(hero, "HeroWave")
    fig.wave(monster, "MonsterRoar", 0.4)


def loose_clips(hero, monster):
    """All are unassigned, and kept by a fake user."""
    clips(hero, monster)
    for obj in (hero, monster, bpy.data.objects["Cam"]):
        obj.animation_data.action.use_fake_user = True
        obj.animation_data.action = None


def nla_clips(hero, monster):
    clips(hero, monster)
    for obj in (hero, monster):
        action = obj.animation_data.action
        obj.animation_data.action = None
        track = obj.animation_data.nla_tracks.new()
        track.name = action.name
        strip = track.strips.new(action.name, 1, action)
        if SLOTS:
            strip.action_slot = action.slots[0]
        track.mute = True


@pytest.mark.parametrize("change", [clips, loose_clips, nla_clips], ids=lambda f: f.__name__)
def test_anothers_clip_is_refused(change, tmp_path, capfd):
    source = two(tmp_path / "in.blend", change)
    for name, reason in (("CameraMove", "belongs to 'Cam'"), ("MonsterRoar", "belongs to 'Monster'")):
        assert fig.run("pose", source, "--out", tmp_path / "out.ply", "--action", name, "--frame", 10) == 2
        error = capfd.readouterr().err
        assert f"The action '{name}' {reason}" in error
        assert "actions of 'Hero': 'HeroWave'" in error
    assert not (tmp_path / "out.ply").exists()
    means = fig.posed_means(source, "--action", "HeroWave", "--frame", 10)
    moved = np.abs(means - fig.cloud().means).max(axis=1)
    assert moved[40:80].max() > 0.3
    assert moved[:40].max() < 1e-5


@pytest.mark.parametrize("change", [clips, loose_clips, nla_clips], ids=lambda f: f.__name__)
def test_only_own_clips_are_exported(change, tmp_path):
    source = two(tmp_path / "in.blend", change)
    assert fig.run("pose", source, "--out", tmp_path / "out.glb") == 0
    assert [clip["name"] for clip in Glb(tmp_path / "out.glb").json["animations"]] == ["HeroWave"]


def test_only_own_clips_come_with_a_rig(tmp_path):
    for change in (clips, loose_clips, nla_clips):
        source = two(tmp_path / f"{change.__name__}.blend", change)
        fig.empty()
        rig_files.import_armature(source, "Hero")
        assert [action.name for action in bpy.data.actions] == ["HeroWave"], change.__name__


def test_blenders_own_dialog_exports_no_others_clips_either(tmp_path):
    obj, hero = fig.open_base()
    hero.name = "Hero"
    monster = fig.add_rig("Monster")
    clips(hero, monster)
    for each in bpy.context.scene.objects:
        each.select_set(each in (obj, hero))
    with gltf_export._discoverable():
        bpy.ops.export_scene.gltf(filepath=str(tmp_path / "out.glb"), use_selection=True)
    assert [clip["name"] for clip in Glb(tmp_path / "out.glb").json["animations"]] == ["HeroWave"]


@pytest.mark.skipif(not SLOTS, reason="slots are Blender 4.4's")
@pytest.mark.parametrize("first", ["other", "own"])
@pytest.mark.parametrize("assigned", [True, False])
def test_the_slot_of_the_armature_moves_it(first, assigned, tmp_path):
    def change(hero, monster):
        slotted(hero, monster, first)
        if not assigned:
            for obj in (hero, monster):
                obj.animation_data.action.use_fake_user = True
                obj.animation_data_clear()

    source = two(tmp_path / "in.blend", change)
    means = fig.posed_means(source, "--action", "Attack", "--frame", 10)
    lift = means[60:80, 2] - fig.cloud().means[60:80, 2]
    hero = bpy.data.objects["Hero"]
    assert hero.animation_data.action_slot.name_display == "Hero"
    turned = hero.pose.bones["arm.L"].rotation_quaternion
    np.testing.assert_allclose(turned, (np.cos(0.5), np.sin(0.5), 0, 0), atol=1e-5)
    assert np.abs(lift).max() > 0.1
    assert fig.run("pose", source, "--out", tmp_path / "out.glb") == 0
    (clip,) = Glb(tmp_path / "out.glb").json["animations"]
    assert clip["name"] == "Attack"


@pytest.mark.skipif(not SLOTS, reason="slots are Blender 4.4's")
def test_a_slot_of_an_older_name_is_found_where_it_is_nobody_elses(tmp_path):
    def change(hero, monster):
        action = slotted(hero, monster)
        action.slots["OBHero"].name_display = "Rig"
        for obj in (hero, monster):
            action.use_fake_user = True
            obj.animation_data_clear()

    source = two(tmp_path / "in.blend", change)
    assert choose_part(bpy.data.objects["Hero"], "Attack").slot.name_display == "Rig"
    fig.empty()
    armature = rig_files.import_armature(source, "Hero")
    assert [slot.name_display for slot in bpy.data.actions["Attack"].slots] == ["Rig"]
    assert choose_part(armature, "Attack").slot.name_display == "Rig"


@pytest.mark.skipif(not SLOTS, reason="slots are Blender 4.4's")
def test_slots_that_could_all_be_meant_have_to_be_named(tmp_path, capfd):
    def change(hero, monster):
        action = slotted(hero, monster)
        for slot, name in zip(action.slots, ("Old", "New"), strict=True):
            slot.name_display = name
        action.use_fake_user = True
        for obj in (hero, monster):
            obj.animation_data_clear()

    source = two(tmp_path / "in.blend", change)
    out = tmp_path / "out.ply"
    assert fig.run("pose", source, "--out", out, "--action", "Attack", "--frame", 10) == 2
    assert "several slots that fit 'Hero': 'Old', 'New'; choose with --slot" in capfd.readouterr().err
    assert fig.run("pose", source, "--out", out, "--action", "Attack", "--frame", 10, "--slot", "New") == 0
    assert fig.run("pose", source, "--out", out, "--action", "Attack", "--slot", "none") == 2
    assert "has no slot 'none' for objects; it has 'Old', 'New'" in capfd.readouterr().err
    assert fig.run("pose", source, "--out", out, "--slot", "New") == 2


def test_an_action_for_other_bones_is_refused():
    fig.empty()
    hero = fig.add_rig("Hero")
    action = fig.wave(hero, "Walk")
    hero.animation_data.action = None
    assert [part.action for part in own_parts(hero)] == [action]
    other = fig.add_rig("Other")
    other.pose.bones["arm.L"].name = "upper_arm"
    bpy.data.objects.remove(hero)
    (part,) = parts_of(action)
    assert not belongs(part, other)
    with pytest.raises(InputError, match=r"moves bones that 'Other' does not have, such as 'arm\.L'"):
        choose_part(other, "Walk")


@pytest.mark.skipif(not SLOTS, reason="slots are Blender 4.4's")
def test_what_moves_the_rig_plays_its_slot_of_the_same_action(tmp_path):
    """A clip of the armature and of its IK target: one action, two slots."""

    def change(hero, monster):
        target = fig.add_empty("target", (0.6, 0, 1.25))
        constraint = hero.pose.bones["hand.L"].constraints.new("IK")
        constraint.target, constraint.chain_count = target, 2
        constraint.pole_target = fig.add_empty("pole", (0.3, -1, 1.6))
        quats = {1: (1, 0, 0, 0), 10: (0.99, 0, 0, 0.14)}
        action = fig.key(hero, "rotation_quaternion", quats, hero.pose.bones["head"], "Reach")
        data = target.animation_data_create()
        data.action, data.action_slot = action, action.slots.new("OBJECT", "target")
        fig.key(target, "location", {1: (0.6, 0, 1.25), 10: (0.3, 0, 1.5)})
        for obj in (hero, target):
            action.use_fake_user = True
            obj.animation_data_clear()
        target.location = (0.6, 0, 1.25)

    source = two(tmp_path / "in.blend", change)
    first, last = (fig.posed_means(source, "--action", "Reach", "--frame", frame) for frame in (1, 10))
    assert np.abs(first - last)[60:80].max() > 0.1
    rig_files.open_blend(source)
    export_glb(tmp_path / "out.glb", [bpy.data.objects["fig"]])
    glb = Glb(tmp_path / "out.glb")
    assert fig.turns_in_clip(glb, "arm.L") > 0.05
    target = bpy.data.objects["target"]
    assert target.animation_data is None or target.animation_data.action is None
    np.testing.assert_allclose(target.location, (0.6, 0, 1.25), atol=1e-6)


def test_a_posed_glb_stands_as_posed(tmp_path):
    source = fig.rigged(tmp_path / "in.blend")
    assert fig.run("pose", source, "--out", tmp_path / "out.glb", *fig.TURN) == 0
    glb = Glb(tmp_path / "out.glb")
    mesh = glb.node("fig")
    attributes = glb.attributes(mesh)
    joints, weights = attributes["JOINTS_0"].astype(int), attributes["WEIGHTS_0"]
    points = np.c_[attributes["POSITION"], np.ones(len(joints))]
    posed = np.einsum("nk,nkij,nj->ni", weights, glb.joint_matrices(mesh)[joints], points)[:, :3]
    posed = posed @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # y up to z up
    np.testing.assert_allclose(posed, fig.expected(fig.cloud().means), atol=1e-4)


def test_without_slots_an_unused_clip_of_two_like_rigs_is_refused(tmp_path, monkeypatch):
    """Blender 4.3 keeps nothing that says whose an action is that nobody uses."""
    two(tmp_path / "two.blend", loose_clips)
    rig_files.open_blend(tmp_path / "two.blend")
    hero = bpy.data.objects["Hero"]
    monkeypatch.setattr(actions, "parts_of", lambda action: [Part(action)])
    monkeypatch.setattr(actions, "bones_of", lambda part: {"arm.L"})
    monkeypatch.setattr(actions, "users_of", lambda part: set())
    with pytest.raises(InputError, match=r"fits 'Hero' and 'Monster', and Blender before 4\.4"):
        choose_part(hero, "MonsterRoar")
    bpy.data.objects.remove(bpy.data.objects["Monster"])
    assert choose_part(hero, "HeroWave").action.name == "HeroWave"


@pytest.mark.skipif(not SLOTS, reason="slots are Blender 4.4's")
def test_unused_clips_of_an_old_file_with_two_like_rigs_are_left_out_and_said(tmp_path, capfd):
    """Opened in 4.4 or later, every action of an older file has one slot of the same name."""

    def change(hero, monster):
        loose_clips(hero, monster)
        for name in ("HeroWave", "MonsterRoar"):
            bpy.data.actions[name].slots[0].name_display = "Legacy Slot"
        fig.wave(hero, "HeroIdle", 0.1)

    source = two(tmp_path / "in.blend", change)
    out = tmp_path / "out.glb"
    words = "2 unused actions ('HeroWave', 'MonsterRoar') may belong to 'Hero' or to 'Monster'"
    assert fig.run("pose", source, "--out", out) == 0
    assert f"Warning: {words}" in capfd.readouterr().err
    assert [clip["name"] for clip in Glb(out).json["animations"]] == ["HeroIdle"]
    assert fig.run("pose", source, "--out", tmp_path / "out.ply", "--action", "MonsterRoar") == 2
    assert "fits 'Hero' and 'Monster'" in capfd.readouterr().err
    notes: list[str] = []
    fig.empty()
    rig_files.import_armature(source, "Hero", notes)
    assert [action.name for action in bpy.data.actions] == ["HeroIdle"]
    assert notes[0].startswith(words)


def test_an_unused_clip_belongs_to_the_rig_that_has_all_its_bones():
    fig.empty()
    hero, other = fig.add_rig("Hero"), fig.add_rig("Other")
    other.pose.bones["hand.L"].name = "paw.L"
    action = fig.wave(hero, "Walk")
    fig.key(hero, "location", {1: (0, 0, 0), 10: (0, 0, 1)}, hero.pose.bones["hand.L"])
    hero.animation_data_clear()
    if SLOTS:
        action.slots[0].name_display = "Legacy Slot"
    assert [part.action for part in own_parts(hero)] == [action]
    assert own_parts(other) == []
    with pytest.raises(InputError, match=r"fits 'Hero' better, which has bone 'hand\.L', too"):
        choose_part(other, "Walk")
