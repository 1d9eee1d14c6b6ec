# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender plays and a clip of a .glb cannot hold is said: mixes of the NLA, and poses without keys."""

from __future__ import annotations

import bpy
import figure_rig as fig
import numpy as np
import pytest
from glb import Glb

from gskin_addon.scene.clip_losses import mixed_tracks
from gskin_addon.scene.gltf_export import export_glb
from gskin_addon.scene.posing import posed_cloud


def push_down(armature, *strips):
    """The active action in a track, once for each start frame."""
    data = armature.animation_data
    action, data.action = data.action, None
    track = data.nla_tracks.new()
    track.name = "Loop"
    for start in strips:
        strip = track.strips.new(f"{action.name}{start}", start, action)
        if hasattr(strip, "action_slot") and strip.action_slot is None:
            strip.action_slot = action.slots[0]
    return track


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rig: push_down(rig, 1, 20), "track 'Loop' has 2 strips"),
        (lambda rig: setattr(push_down(rig, 1).strips[0], "blend_in", 3), "track 'Loop' blends by influence"),
        (lambda rig: setattr(push_down(rig, 1).strips[0], "blend_type", "COMBINE"), "adds to what is below"),
        (lambda rig: setattr(push_down(rig, 1).strips[0], "repeat", 2), "plays faster, slower, again or backwards"),
        (lambda rig: push_down(rig, 1), ""),
        (lambda rig: setattr(push_down(rig, 1, 20), "mute", True), ""),
    ],
)
def test_what_the_nla_makes_of_actions_is_said(change, words, tmp_path, capfd):
    def animated(splats, armature):
        fig.wave(armature, "Wave")
        change(armature)

    source = fig.rigged(tmp_path / "in.blend", animated)
    assert fig.run("pose", source, "--out", tmp_path / "out.glb") == 0
    said = capfd.readouterr().err
    assert ("Warning: glTF has clips and no NLA" in said) == bool(words)
    assert words in said
    (clip,) = Glb(tmp_path / "out.glb").json["animations"]
    assert clip["name"] in ("Wave", "Loop")
    assert fig.turns_in_clip(Glb(tmp_path / "out.glb"), "arm.L") > 0.1


def test_a_track_without_strips_or_action_is_nothing_to_say():
    _, armature = fig.open_base()
    assert mixed_tracks(armature) == []
    armature.animation_data_create().nla_tracks.new()
    assert mixed_tracks(armature) == []


def test_a_bone_without_keys_stands_as_posed_and_is_at_rest_in_clips(tmp_path, capfd):
    def posed(splats, armature):
        fig.wave(armature, "Wave")
        armature.pose.bones["head"].rotation_quaternion = (0.8, 0.6, 0, 0)
        bpy.context.view_layer.update()

    source = fig.rigged(tmp_path / "in.blend", posed)
    by_frame = fig.posed_means(source, "--frame", 10)
    words = "'head' of 'Rig' has no keys and stands as posed by hand, as Blender shows it"
    assert words in capfd.readouterr().err
    by_action = fig.posed_means(source, "--frame", 10, "--action", "Wave")
    assert words not in capfd.readouterr().err
    head, arm = slice(20, 40), slice(40, 80)
    assert np.abs(by_frame[head] - by_action[head]).max() > 0.1
    np.testing.assert_allclose(by_frame[arm], by_action[arm], atol=1e-6)
    assert fig.run("pose", source, "--out", tmp_path / "out.glb") == 0
    assert "Warning: 'head' of 'Rig' is posed by hand without keys, and at rest in the clips" in capfd.readouterr().err
    glb = Glb(tmp_path / "out.glb")
    in_clip = glb.posed(glb.node("fig"), 9 / bpy.context.scene.render.fps)
    np.testing.assert_allclose(in_clip, by_action, atol=1e-4)


@pytest.mark.parametrize("which", ["splats", "parent", "armature's parent"])
def test_splats_that_move_as_an_object_are_said(which, tmp_path, capfd):
    def change(splats, armature):
        fig.wave(armature, "Wave")
        moved = splats if which == "splats" else fig.add_empty("Cart")
        if which == "parent":
            splats.parent = moved
        elif which != "splats":
            armature.parent = moved
        else:
            splats.parent = None
        fig.key(moved, "location", {1: (0, 0, 0), 10: (0, 1, 0)}, name="Move")

    source = fig.rigged(tmp_path / "in.blend", change)
    assert fig.run("pose", source, "--out", tmp_path / "out.glb") == 0
    said = capfd.readouterr().err
    assert ("Warning: glTF moves skinned splats by their joints alone" in said) == (which != "armature's parent")


def test_stretched_time_is_said(tmp_path, capfd):
    def change(splats, armature):
        fig.wave(armature, "Wave")
        bpy.context.scene.render.frame_map_new = 200

    source = fig.rigged(tmp_path / "in.blend", change)
    assert fig.run("pose", source, "--out", tmp_path / "out.glb") == 0
    said = capfd.readouterr().err
    assert "Warning: The scene stretches time (100 to 200), and the clips of 'Rig' are cut off" in said


def test_an_export_leaves_the_pose_as_it_was(tmp_path):
    """Blender's exporter puts all bones to rest between two clips."""
    splats, armature = fig.open_base()
    fig.wave(armature, "Wave")
    armature.animation_data.action.use_fake_user = True
    armature.animation_data.action = None
    fig.wave(armature, "Nod", 0.3)
    armature.pose.bones["head"].rotation_quaternion = (0.8, 0.6, 0, 0)
    bpy.context.view_layer.update()
    before = posed_cloud(splats).means
    export_glb(tmp_path / "out.glb", [splats])
    bpy.context.view_layer.update()
    np.testing.assert_allclose(posed_cloud(splats).means, before, atol=1e-6)
    assert armature.animation_data.action.name == "Nod"
    assert len(Glb(tmp_path / "out.glb").json["animations"]) == 2


def test_a_frame_of_an_action_is_what_a_posed_glb_stands_in(tmp_path):
    """Blender's exporter would go to frame 0."""

    def animated(splats, armature):
        fig.wave(armature, "Wave")
        # What moves the bone besides is animated, too.
        target = fig.add_empty("target", (0.6, 0, 1.25))
        fig.key(target, "location", {1: (0.6, 0, 1.25), 10: (0.3, 0, 1.5)})
        constraint = armature.pose.bones["hand.R"].constraints.new("COPY_LOCATION")
        constraint.target = target

    source = fig.rigged(tmp_path / "in.blend", animated)
    for arguments in (("--frame", 7.5), ("--frame", 10, "--action", "Wave")):
        wanted = fig.posed_means(source, *arguments)
        assert fig.run("pose", source, "--out", tmp_path / "out.glb", *arguments) == 0
        glb = Glb(tmp_path / "out.glb")
        np.testing.assert_allclose(glb.posed(glb.node("fig")), wanted, atol=1e-4)
