# SPDX-License-Identifier: GPL-3.0-or-later
"""Smooth, sharpen, mirror, assign: the operators on splat objects, against the functions of the core."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.rig.lbs import sparsify
from gskin_addon.core.skinning.edits.blend import sharpen, smooth
from gskin_addon.core.skinning.edits.body_graph import body_graph
from gskin_addon.core.skinning.edits.keep import keep
from gskin_addon.scene import names as attributes
from gskin_addon.scene.compared import is_edited
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.stand_in import readable
from gskin_addon.scene.weight_edits import iter_edit_weights
from gskin_addon.scene.weights import read_weights, write_weights

COUNT, BONES = 400, 6


@pytest.fixture(scope="module", autouse=True)
def registered():
    gskin_addon.register()
    yield
    gskin_addon.unregister()


@pytest.fixture
def scene():
    """Splats bound to an armature, chosen; and their weights."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng(5)
    cloud = clouds.random_cloud(COUNT, 1)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(BONES, rng)
    rigs.place(armature, (1, 2, 0.3), (0.3, 0.4, 0.5), 1.7)
    weights = sparsify(rigs.random_weights(cloud, BONES, rng), 4)
    obj.vertex_groups.new(name="mine").add([3, 4], 0.5, "REPLACE")
    write_weights(obj, armature, weights)
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj
    return obj, armature, read_weights(obj)[0]


def select(obj, mask):
    obj.data.vertices.foreach_set("select", mask)
    obj.data.update()


def test_smooth_is_the_cores_and_the_splats_turn_with_it(scene):
    obj, _armature, before = scene
    assert bpy.ops.gskin.smooth_weights(factor=0.7, repeat=3) == {"FINISHED"}
    graph = body_graph(read_cloud(obj).means)
    expected = keep(before, smooth(before, graph, factor=0.7, repeat=3), most=4)
    np.testing.assert_allclose(read_weights(obj)[0], expected, atol=1e-6)
    assert not np.allclose(expected, before, atol=0.01)


def test_turns_follow_at_once(scene):
    obj, armature, _ = scene
    bpy.ops.gskin.sharpen_weights(amount=0.5)
    rigs.random_pose(armature, np.random.default_rng(1), 0.8)
    rigs.assert_same_pose(obj, armature)


def test_selection_locks_order_and_other_groups_stay(scene):
    obj, _armature, before = scene
    names = [group.name for group in obj.vertex_groups]
    locked = names[2]
    obj.vertex_groups[locked].lock_weight = True
    obj.vertex_groups.active_index = 3
    selected = np.arange(COUNT) % 3 == 0
    select(obj, selected)
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.gskin.sharpen_weights(amount=0.9) == {"FINISHED"}
    assert obj.mode == "EDIT"
    bpy.ops.object.mode_set(mode="OBJECT")
    after, bones = read_weights(obj)
    column = bones.index(locked)
    assert np.array_equal(after[~selected], before[~selected])
    assert np.array_equal(after[:, column], before[:, column])
    np.testing.assert_allclose(after.sum(axis=1), 1, atol=1e-6)
    mask = np.arange(len(bones)) == column
    expected = keep(before, sharpen(before, 0.9), selected=selected, locked=mask, most=4)
    np.testing.assert_allclose(after, expected, atol=1e-6)
    assert sorted(group.name for group in obj.vertex_groups) == sorted(names)
    assert obj.vertex_groups[locked].lock_weight
    assert obj.vertex_groups.active.name == names[3]
    assert obj.vertex_groups["mine"].weight(3) == 0.5


def test_edit_mode_is_not_left(scene):
    """Blender draws all splats each time that it is left or entered."""
    obj, armature, before = scene
    bones = read_weights(obj)[1]
    group = obj.vertex_groups[bones[2]]
    obj.vertex_groups.remove(group)
    before[:, 2] = 0
    selected = np.arange(COUNT) % 3 == 0
    select(obj, selected)
    bpy.ops.object.mode_set(mode="EDIT")
    objects, meshes = len(bpy.data.objects), len(bpy.data.meshes)
    wanted = np.zeros_like(before)
    wanted[:, [2, 4]] = 0.25, 0.75
    for end in ("given up", "whole"):
        steps = iter_edit_weights(obj, lambda weights: wanted, selected)
        shares = []
        for share in steps:
            assert obj.mode == "EDIT"
            shares.append(share)
            if end == "given up" and share > 0.6:
                assert (edited_weights(obj)[0] != before).any(), "the last slices change the scene"
                steps.close()
        assert max(shares) > 0.6
        if end == "given up":
            assert np.array_equal(edited_weights(obj)[0], before)
        assert (len(bpy.data.objects), len(bpy.data.meshes)) == (objects, meshes)
    bpy.ops.object.mode_set(mode="OBJECT")
    after = read_weights(obj, bones)[0]
    np.testing.assert_allclose(after[selected], wanted[selected], atol=1e-6)
    assert np.array_equal(after[~selected], before[~selected])
    assert not in_group(obj, bones[0])[selected].any(), "without weight in no group"
    assert is_edited(obj)
    rigs.random_pose(armature, np.random.default_rng(1), 0.8)
    rigs.assert_same_pose(obj, armature)


def edited_weights(obj):
    """The weights of what is edited."""
    with readable(obj) as there:
        return read_weights(there)


def in_group(obj, name):
    """(N,) which splats are in a vertex group."""
    index = obj.vertex_groups[name].index
    return np.array([any(group.group == index for group in vertex.groups) for vertex in obj.data.vertices])


def test_a_refusal_in_edit_mode_names_the_object(scene):
    obj, _armature, _before = scene
    obj.data.attributes.remove(obj.data.attributes[attributes.SCALE])
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(RuntimeError, match="'S' has lost its splat attribute"):
        bpy.ops.gskin.smooth_weights()
    assert obj.mode == "EDIT"
    assert not [other for other in bpy.data.objects if other.name.startswith("S.")]


def test_to_bone_flood_and_neighbours(scene):
    obj, _armature, before = scene
    bones = read_weights(obj)[1]
    selected = np.arange(COUNT) < 20
    select(obj, selected)
    assert bpy.ops.gskin.assign_to_bone(bone=bones[1]) == {"FINISHED"}
    after = read_weights(obj)[0]
    assert (after[selected, 1] == 1).all()
    assert np.array_equal(after[~selected], before[~selected])
    assert bpy.ops.gskin.flood_weights(bone=bones[2], weight=0.25) == {"FINISHED"}
    np.testing.assert_allclose(read_weights(obj)[0][selected][:, [1, 2]], [[0.75, 0.25]] * 20, atol=1e-6)
    assert bpy.ops.gskin.follow_neighbours() == {"FINISHED"}
    healed = read_weights(obj)[0]
    assert np.array_equal(healed[~selected], before[~selected])
    assert np.abs(healed[selected] - after[selected]).max() > 0.1
    np.testing.assert_allclose(healed.sum(axis=1), 1, atol=1e-5)


def test_a_soft_rim_changes_splats_around_the_selection(scene):
    obj, _armature, before = scene
    bones = read_weights(obj)[1]
    select(obj, np.arange(COUNT) < 5)
    bpy.ops.gskin.assign_to_bone(bone=bones[1], rim=0.5)
    changed = (read_weights(obj)[0] != before).any(axis=1)
    assert changed[:5].all()
    assert 5 < changed.sum() < COUNT


def test_nothing_selected_and_wrong_bones_are_refused(scene):
    obj, _armature, before = scene
    select(obj, np.zeros(COUNT, bool))
    with pytest.raises(RuntimeError, match="No splats of 'S' are selected"):
        bpy.ops.gskin.flood_weights()
    select(obj, np.ones(COUNT, bool))
    with pytest.raises(RuntimeError, match="'mine' is no deform bone"):
        bpy.ops.gskin.flood_weights(bone="mine")
    for group in obj.vertex_groups:
        group.lock_weight = True
    with pytest.raises(RuntimeError, match="locked"):
        bpy.ops.gskin.sharpen_weights()
    assert np.array_equal(read_weights(obj)[0], before)


def test_splats_without_weights_stay_so_or_take_what_is_given(scene):
    """They stand still; nothing gives them to the first bone, which would drag them along."""
    obj, _armature, _before = scene
    bones = read_weights(obj)[1]
    loose = np.arange(COUNT) < 30
    for name in bones:
        obj.vertex_groups[name].remove(np.flatnonzero(loose).tolist())
    bpy.context.view_layer.update()
    bpy.ops.gskin.sharpen_weights(amount=0.4)
    assert (read_weights(obj)[0][loose] == 0).all()
    select(obj, loose)
    bpy.ops.gskin.flood_weights(bone=bones[3], weight=0.5)
    assert (read_weights(obj)[0][loose, 3] == 1).all()
    obj.vertex_groups[bones[3]].remove(np.flatnonzero(loose).tolist())
    bpy.context.view_layer.update()
    before = read_weights(obj)[0]
    bpy.ops.gskin.smooth_weights(factor=0.5, repeat=1)
    graph = body_graph(read_cloud(obj).means)
    row = int(np.flatnonzero(loose & graph.linked.any(axis=1))[0])
    mean = before[graph.neighbour[row][graph.linked[row]]].sum(axis=0)
    expected = keep(before, np.tile(mean, (COUNT, 1)), most=4)[row]
    np.testing.assert_allclose(read_weights(obj)[0][row], expected, atol=1e-5)


def test_face_selection_of_weight_paint_is_a_selection(scene):
    obj, _armature, before = scene
    assert bpy.ops.gskin.make_paintable() == {"FINISHED"}
    faces = np.zeros(len(obj.data.polygons), bool)
    faces[:20], hidden = True, np.zeros(len(faces), bool)
    hidden[10:15] = True
    obj.data.polygons.foreach_set("select", faces)
    obj.data.polygons.foreach_set("hide", hidden)
    meant = {int(i) for face in np.flatnonzero(faces & ~hidden) for i in obj.data.polygons[face].vertices}
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    obj.data.use_paint_mask = True
    select(obj, np.ones(COUNT, bool))
    assert bpy.ops.gskin.sharpen_weights(amount=0.9) == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    changed = set(np.flatnonzero((read_weights(obj)[0] != before).any(axis=1)).tolist())
    assert changed
    assert changed <= meant


def test_mirror_needs_sides(scene):
    _obj, _armature, _before = scene
    with pytest.raises(RuntimeError, match="left and right"):
        bpy.ops.gskin.mirror_weights()


def test_undo_brings_the_weights_back(scene):
    _obj, _armature, before = scene
    bpy.context.preferences.edit.use_global_undo = True
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.gskin.sharpen_weights(amount=1.0)
    bpy.ops.ed.undo_push(message="after")
    assert not np.array_equal(read_weights(bpy.data.objects["S"])[0], before)
    bpy.ops.ed.undo()
    assert np.array_equal(read_weights(bpy.data.objects["S"])[0], before)
