# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer Weights: from a skinned mesh and from other splats to splats, and from splats to a mesh."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
from proxy_meshes import tube

bpy = pytest.importorskip("bpy")
from mathutils import Matrix

import gskin_addon
from gskin_addon.core.rig.lbs import sparsify
from gskin_addon.core.splats.from_mesh import sample_mesh
from gskin_addon.scene.bone_frames import armature_of
from gskin_addon.scene.compared import is_edited
from gskin_addon.scene.fabric import has_fabric
from gskin_addon.scene.proxy_object import create_mesh_object
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import read_weights, write_weights

BONES = ("a", "b", "c")


@pytest.fixture(scope="module", autouse=True)
def registered():
    gskin_addon.register()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield
    gskin_addon.unregister()


@pytest.fixture(autouse=True)
def empty_scene():
    """Without objects; node groups stay, which take long to make."""
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)


def figure():
    """A tube along x: verts, faces and weights (V, 3) of three bones."""
    verts, faces = tube(3, 31, 12, 0.2)
    verts[:12, 1:] = verts[-12:, 1:] = 0
    near = np.exp(-6 * np.maximum(np.abs(verts[:, :1] - [0.5, 1.5, 2.5]) - 0.4, 0))
    near[near < 0.02] = 0
    return verts, faces, (near / near.sum(1, keepdims=True)).astype(np.float32)


def make_rig():
    data = bpy.data.armatures.new("Rig")
    armature = bpy.data.objects.new("Rig", data)
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for k, name in enumerate(BONES):
        bone = data.edit_bones.new(name)
        bone.head, bone.tail = (k, 0, 0), (k + 1, 0, 0)
        bone.parent = data.edit_bones[BONES[k - 1]] if k else None
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


def make_splats(name, seed, count=900):
    verts, faces, weights = figure()
    rng = np.random.default_rng(seed)
    cloud, face, bary = sample_mesh(verts, faces, np.full((len(faces), 3, 3), 0.5), count, rng, below=0)
    return create_splat_object(cloud, name), np.einsum("nk,nkb->nb", bary, weights[faces[face]])


def make_mesh(armature=None):
    verts, faces, weights = figure()
    mesh = create_mesh_object("Body", verts, faces)
    if armature is not None:
        for column, name in enumerate(BONES):
            group = mesh.vertex_groups.new(name=name)
            for row in np.flatnonzero(weights[:, column]):
                group.add([int(row)], float(weights[row, column]), "REPLACE")
        mesh.modifiers.new("Armature", "ARMATURE").object = armature
    return mesh


def choose(active, *others):
    bpy.context.view_layer.update()  # new objects can be selected only then
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj in (active, *others))
    bpy.context.view_layer.objects.active = active


def test_new_splats_get_the_weights_of_the_mesh_wherever_both_stand():
    """Posed and moved, object and mesh in different spaces: what counts is the rest pose in the world."""
    armature = make_rig()
    mesh = make_mesh(armature)
    mesh.vertex_groups.new(name="Hat").add([0], 1.0, "REPLACE")
    splats, truth = make_splats("New", 0)
    place = ((0.3, -1, 2), (0.4, 0.1, 1.2), 1.0)
    for obj in (armature, mesh, splats):
        rigs.place(obj, *place)
    mesh.data.transform(Matrix.Translation((1, 2, 3)))
    mesh.matrix_world = mesh.matrix_world @ Matrix.Translation((-1, -2, -3))
    rigs.random_pose(armature, np.random.default_rng(0), 0.7)
    choose(splats, mesh)
    assert bpy.ops.gskin.transfer_weights() == {"FINISHED"}
    assert armature_of(splats) == armature
    weights = read_weights(splats, BONES)[0]
    assert np.abs(weights - truth).sum(1).mean() < 0.05
    assert "Hat" not in splats.vertex_groups
    assert has_fabric(splats)
    rigs.assert_same_pose(splats, armature)


def test_a_new_capture_gets_the_weights_of_the_old_one_and_hand_work_stays():
    armature = make_rig()
    old, its = make_splats("Old", 1)
    write_weights(old, armature, its.astype(np.float32), BONES)
    new, truth = make_splats("New", 2)
    wrong = np.full((len(truth), 3), 1 / 3, np.float32)
    write_weights(new, armature, wrong, BONES)
    new.vertex_groups["b"].lock_weight = True
    before = read_weights(new, BONES)[0]
    selected = np.arange(len(truth)) % 2 == 0
    choose(new, old)
    bpy.ops.object.mode_set(mode="OBJECT")
    new.data.vertices.foreach_set("select", selected)
    new.data.use_paint_mask_vertex = True
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    assert bpy.ops.gskin.transfer_weights(source="Old") == {"FINISHED"}
    assert new.mode == "WEIGHT_PAINT"
    bpy.ops.object.mode_set(mode="OBJECT")
    after = read_weights(new, BONES)[0]
    assert np.array_equal(after[~selected], before[~selected])
    assert np.array_equal(after[:, 1], before[:, 1])
    np.testing.assert_allclose(after.sum(1), 1, atol=1e-5)
    open_ = truth[:, [0, 2]] / np.maximum(truth[:, [0, 2]].sum(1, keepdims=True), 1e-9) * (2 / 3)
    told = selected & (truth[:, [0, 2]].sum(1) > 0.3)
    assert np.abs(after[told][:, [0, 2]] - open_[told]).sum(1).mean() < 0.1
    assert is_edited(new)


def test_a_mesh_gets_the_weights_of_the_splats_and_follows():
    armature = make_rig()
    splats, its = make_splats("S", 3, 1500)
    write_weights(splats, armature, sparsify(its.astype(np.float32), 4), BONES)
    mesh = make_mesh()
    mesh.vertex_groups.new(name="Mine").add([4], 0.5, "REPLACE")
    choose(splats, mesh)
    assert bpy.ops.gskin.transfer_weights_to_mesh() == {"FINISHED"}
    truth = figure()[2]
    weights = read_weights(mesh, BONES)[0]
    assert np.abs(weights - truth).sum(1).mean() < 0.1
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-5)
    assert mesh.find_armature() == armature
    assert mesh.vertex_groups["Mine"].weight(4) == 0.5


def test_refusals_name_object_and_remedy():
    armature = make_rig()
    mesh = make_mesh(armature)
    splats, _ = make_splats("S", 4, 200)
    choose(splats, mesh)
    mesh.location.x = 500
    with pytest.raises(RuntimeError, match="same place"):
        bpy.ops.gskin.transfer_weights()
    mesh.location.x = 0
    mesh.modifiers.new("Mirror", "MIRROR")
    with pytest.raises(RuntimeError, match="Mirror modifier"):
        bpy.ops.gskin.transfer_weights()
    mesh.modifiers.remove(mesh.modifiers["Mirror"])
    for group in mesh.vertex_groups:
        group.name = "x" + group.name
    with pytest.raises(RuntimeError, match="No vertex group of 'Body' is called as a deform bone of 'Rig'"):
        bpy.ops.gskin.transfer_weights()
    choose(splats)
    with pytest.raises(RuntimeError, match="Select one object with vertex groups"):
        bpy.ops.gskin.transfer_weights()
    assert armature_of(splats) is None
