# SPDX-License-Identifier: GPL-3.0-or-later
"""Linked duplicates of splats: whoever is bound gets a mesh of its own, and the others keep weights and turns."""

from __future__ import annotations

import bpy
import figure_rig as fig
import numpy as np
import pretend
import pytest

from gskin_addon.core.rig.weights_file import write_weights_file
from gskin_addon.scene.armature import read_skeleton
from gskin_addon.scene.bone_frames import armature_of
from gskin_addon.scene.node_groups import find_display
from gskin_addon.scene.posing import posed_cloud, turn_bones
from gskin_addon.scene.weights import read_weights, update_rotation_weights
from gskin_addon.session import running_job
from gskin_addon.session.readiness import checks


@pytest.fixture
def scene(tmp_path, monkeypatch):
    with pretend.session(tmp_path, monkeypatch):
        splats, armature = fig.open_base()
        yield splats, armature, tmp_path


def linked_duplicate(splats, armature=None):
    twin = splats.copy()
    bpy.context.scene.collection.objects.link(twin)
    if armature is not None:
        twin.parent = None
        for modifier in list(twin.modifiers):
            if modifier.type == "ARMATURE" or modifier.name == "GSkin Rotation":
                twin.modifiers.remove(modifier)
    assert twin.data == splats.data
    return twin


def choose(*objects):
    for obj in bpy.context.scene.objects:
        obj.select_set(obj in objects)
    bpy.context.view_layer.objects.active = objects[0]
    bpy.context.scene.gskin.splats, bpy.context.scene.gskin.armature = objects[0], objects[1]


def other_rig():
    """The same bones in another order, and one more."""
    armature = fig.add_rig("Other")
    bpy.ops.object.mode_set(mode="EDIT")
    extra = armature.data.edit_bones.new("aaa")
    extra.head, extra.tail = (0, 0, 0), (0, 0, 0.5)
    armature.data.edit_bones["spine"].parent = extra
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


def shown(obj):
    """Evaluated centres and rotations of the splats, as the modifiers give them."""
    bpy.context.view_layer.update()
    display = find_display(obj)
    display.show_viewport = False
    bpy.context.view_layer.update()
    mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    places, turns = np.empty((120, 3), np.float32), np.empty((120, 4), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", places.reshape(-1))
    mesh.attributes["rotation"].data.foreach_get("value", turns.reshape(-1))
    display.show_viewport = True
    return places, turns


def auto_skin(folder):
    assert bpy.ops.gskin.auto_skin() == {"FINISHED"}


def load_weights(folder):
    armature = bpy.context.scene.gskin.armature
    skeleton = read_skeleton(armature)
    weights = np.zeros((120, skeleton.count), np.float32)
    weights[:, 0] = 1
    path = folder / "w.npz"
    write_weights_file(path, weights, skeleton)
    assert bpy.ops.gskin.load_weights(filepath=str(path)) == {"FINISHED"}


def bind_again(folder):
    assert bpy.ops.gskin.bind_to_armature() == {"FINISHED"}


@pytest.mark.parametrize("two_rigs", [False, True])
@pytest.mark.parametrize("click", [auto_skin, load_weights, bind_again], ids=lambda f: f.__name__)
def test_the_other_keeps_weights_and_turns(click, two_rigs, scene):
    splats, armature, folder = scene
    target = other_rig() if two_rigs else armature
    twin = linked_duplicate(splats, target if two_rigs else None)
    turn_bones(armature, {"arm.L": (0, -60, 0)})
    weights, (places, turns) = read_weights(splats)[0], shown(splats)
    choose(twin, target)
    (check,) = (check for check in checks(bpy.context) if check.name == "Owner")
    assert check.state == "warn"
    assert check.sentence == "'fig.001' shares its mesh with 'fig', and will get one of its own"
    click(folder)
    assert twin.data != splats.data
    assert armature_of(twin) == target
    assert armature_of(splats) == armature
    np.testing.assert_array_equal(read_weights(splats)[0], weights)
    after = shown(splats)
    np.testing.assert_array_equal(after[0], places)
    np.testing.assert_array_equal(after[1], turns)
    # And the other one is moved by its own.
    before = posed_cloud(twin).means
    turn_bones(target, {"head" if click is bind_again else read_skeleton(target).names[0]: (0, 40, 0)})
    assert np.abs(posed_cloud(twin).means - before).max() > 0.05


def test_it_is_said(scene, monkeypatch):
    splats, armature, folder = scene
    twin = linked_duplicate(splats)
    choose(twin, armature)
    auto_skin(folder)
    assert "'fig.001' has a mesh of its own now; it shared one with 'fig'" in running_job.state.outcome
    choose(twin, armature)
    auto_skin(folder)
    assert "mesh of its own" not in running_job.state.outcome


def test_tools_of_weights_say_it_too(scene, capfd):
    splats, armature, folder = scene
    twin = linked_duplicate(splats)
    choose(twin, armature)
    fig.save(folder / "twins.blend")
    capfd.readouterr()
    assert bpy.ops.gskin.smooth_weights() == {"FINISHED"}
    assert "'fig.001' has a mesh of its own now; it shared one with 'fig'" in capfd.readouterr().out
    assert (read_weights(splats)[0] != read_weights(twin)[0]).any()
    assert bpy.ops.gskin.smooth_weights() == {"FINISHED"}
    assert "mesh of its own" not in capfd.readouterr().out
    arguments = ("--object", "fig.001", "--smooth", 2, "--out", folder / "out.blend")
    assert fig.run("weights", folder / "twins.blend", *arguments) == 0
    assert "'fig.001' has a mesh of its own now; it shared one with 'fig'." in capfd.readouterr().err


def test_twins_that_were_never_bound_end_with_weights_of_their_own(scene):
    splats, armature, folder = scene
    twin = linked_duplicate(splats, armature)
    weights = read_weights(splats)[0]
    for obj in (twin, splats):
        choose(obj, armature)
        auto_skin(folder)
    assert twin.data != splats.data
    assert (read_weights(splats)[0] != weights).any()


def test_painting_a_shared_mesh_of_one_rig_does_not_part_it(scene):
    splats, armature, _ = scene
    twin = linked_duplicate(splats)
    splats.vertex_groups["head"].add(range(10), 1.0, "REPLACE")
    choose(splats, armature)
    update_rotation_weights(splats)
    assert twin.data == splats.data


def test_linked_splats_are_refused_before_the_job(scene, tmp_path):
    fig.save(tmp_path / "lib.blend")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "lib.blend"), link=True) as (_, target):
        target.objects = ["fig"]
    bpy.context.scene.collection.objects.link(target.objects[0])
    armature = fig.add_rig("Mine")
    choose(target.objects[0], armature)
    (check,) = (check for check in checks(bpy.context) if check.name == "Owner")
    assert check.state == "stop"
    with pytest.raises(RuntimeError, match="is linked from another file"):
        bpy.ops.gskin.auto_skin()
