# SPDX-License-Identifier: GPL-3.0-or-later
"""The fabric under splats: changes nothing that is posed, drawn, exported or counted, and tools work on it."""

from __future__ import annotations

import json
import struct

import bpy
import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

import gskin_addon
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.scene import fabric_view
from gskin_addon.scene.fabric import has_fabric, iter_make_fabric, strip_fabric
from gskin_addon.scene.gltf_export import export_glb
from gskin_addon.scene.node_groups import find_display, set_display
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.rotation_nodes import find_rotation
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.steps import run_to_end
from gskin_addon.scene.weights import read_weights, write_weights

COUNT, BONES = 600, 5


@pytest.fixture(scope="module", autouse=True)
def registered():
    gskin_addon.register()
    yield
    gskin_addon.unregister()


@pytest.fixture
def scene():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng(4)
    cloud: SplatCloud = clouds.random_cloud(COUNT, 1)
    means = rng.normal(size=(COUNT, 3))
    cloud.means[:] = means / np.linalg.norm(means, axis=1, keepdims=True)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(BONES, rng)
    write_weights(obj, armature, rigs.random_weights(cloud, BONES, rng))
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    return obj, armature


def evaluated(obj):
    """Points and number of faces of what is drawn."""
    mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    return np.array([v.co for v in mesh.vertices]), len(mesh.polygons)


def test_nothing_that_is_posed_or_drawn_changes(scene):
    obj, armature = scene
    rigs.random_pose(armature, np.random.default_rng(1), 0.8)
    bpy.context.view_layer.update()
    cloud, weights, posed, drawn = read_cloud(obj), read_weights(obj)[0], posed_cloud(obj), evaluated(obj)
    count = run_to_end(iter_make_fabric(obj))
    assert count == len(obj.data.polygons) > COUNT
    assert has_fabric(obj)
    assert not obj.data.validate(verbose=True)
    bpy.context.view_layer.update()
    for before, after in ((cloud, read_cloud(obj)), (posed, posed_cloud(obj))):
        assert np.array_equal(before.means, after.means)
        assert np.array_equal(before.quats, after.quats)
        assert np.array_equal(before.sh, after.sh)
    assert np.array_equal(read_weights(obj)[0], weights)
    after = evaluated(obj)
    assert np.array_equal(drawn[0], after[0])
    assert drawn[1] == after[1]
    rigs.assert_same_pose(obj, armature)


def test_nothing_turns_splats_in_edit_mode(scene, tmp_path):
    """Blender would make a mesh of what is edited after each click; files of older versions are mended."""
    obj, armature = scene
    assert not find_rotation(obj).show_in_editmode
    find_rotation(obj).show_in_editmode = True
    one, other = obj.name, armature.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "old.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "old.blend"))
    obj, armature = bpy.data.objects[one], bpy.data.objects[other]
    assert not find_rotation(obj).show_in_editmode
    rigs.random_pose(armature, np.random.default_rng(1), 0.8)
    bpy.context.view_layer.update()
    posed, rest = posed_cloud(obj), read_cloud(obj)
    assert np.abs(posed.means - rest.means).max() > 0.1
    bpy.ops.object.mode_set(mode="EDIT")
    assert np.allclose(evaluated(obj)[0], posed.means, atol=1e-4), "edited where the pose puts them"
    bpy.ops.object.mode_set(mode="OBJECT")
    rigs.assert_same_pose(obj, armature)


def test_without_a_display_nothing_is_seen(scene):
    obj, _ = scene
    run_to_end(iter_make_fabric(obj))
    set_display(obj, "Display", False)
    points, faces = evaluated(obj)
    assert (len(points), faces) == (COUNT, 0)


def test_made_again_and_taken_away(scene):
    obj, _ = scene
    cloud, weights = read_cloud(obj), read_weights(obj)[0]
    first = run_to_end(iter_make_fabric(obj))
    assert run_to_end(iter_make_fabric(obj)) == first == len(obj.data.polygons)
    plain = obj.data.copy()
    edges = {tuple(sorted(edge.vertices)) for edge in plain.edges}
    plain.update(calc_edges=True)
    assert len(edges) == len(plain.edges) == len(obj.data.edges), "the edges that Blender would find"
    strip_fabric(obj.data)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(read_cloud(obj), name), getattr(cloud, name)), name
    assert np.array_equal(read_weights(obj)[0], weights)
    assert not has_fabric(obj)
    assert (len(obj.data.vertices), len(obj.data.edges)) == (COUNT, 0)
    assert bpy.ops.gskin.make_paintable() == {"FINISHED"}
    assert has_fabric(obj)
    assert bpy.ops.gskin.remove_fabric() == {"FINISHED"}
    assert not has_fabric(obj)
    assert not bpy.ops.gskin.remove_fabric.poll()


def test_what_is_selected_stays_so(scene):
    obj, _ = scene
    chosen = np.arange(COUNT) % 7 == 0
    obj.data.vertices.foreach_set("select", chosen)
    run_to_end(iter_make_fabric(obj))
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.object.mode_set(mode="OBJECT")
    after = np.zeros(COUNT, bool)
    obj.data.vertices.foreach_get("select", after)
    assert np.array_equal(after, chosen)


def test_exports_are_points(scene, tmp_path):
    obj, _ = scene
    before = tmp_path / "before.glb"
    export_glb(before, [obj])
    run_to_end(iter_make_fabric(obj))
    mesh = obj.data
    after = tmp_path / "after.glb"
    export_glb(after, [obj])
    assert obj.data == mesh
    assert has_fabric(obj)

    def content(path):
        raw = path.read_bytes()
        length = struct.unpack("<I", raw[12:16])[0]
        return json.loads(raw[20 : 20 + length]), raw[20 + length :]

    one, other = content(before), content(after)
    primitives = other[0]["meshes"][0]["primitives"]
    assert [primitive.get("mode", 4) for primitive in primitives] == [0]
    assert one[1] == other[1]
    assert len(bpy.data.meshes) == len({m.name for m in bpy.data.meshes})


def test_the_display_goes_while_it_is_painted_and_comes_back(scene):
    obj, _ = scene
    run_to_end(iter_make_fabric(obj))
    display = find_display(obj)
    for mode in ("WEIGHT_PAINT", "EDIT"):
        bpy.ops.object.mode_set(mode=mode)
        bpy.context.view_layer.update()
        fabric_view.apply_to_all()
        assert not display.show_viewport
        assert display.show_render
        bpy.ops.object.mode_set(mode="OBJECT")
        bpy.context.view_layer.update()
        fabric_view.apply_to_all()
        assert display.show_viewport
    strip_fabric(obj.data)
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    fabric_view.apply_to_all()
    assert display.show_viewport, "there is nothing to show in its place"
    bpy.ops.object.mode_set(mode="OBJECT")


def test_blenders_own_smooth_and_select_more_work(scene):
    obj, _ = scene
    before = read_weights(obj)[0]
    run_to_end(iter_make_fabric(obj))
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    bpy.ops.object.vertex_group_smooth(group_select_mode="ALL", factor=0.5, repeat=1)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    assert (read_weights(obj)[0] != before).any(axis=1).mean() > 0.9
    obj.data.vertices[0].select = True
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_more()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert 3 < sum(v.select for v in obj.data.vertices) < 30


def test_edit_mode_selects_on_the_posed_figure(scene):
    obj, _ = scene
    modifier = next(modifier for modifier in obj.modifiers if modifier.type == "ARMATURE")
    assert modifier.show_in_editmode
    assert modifier.show_on_cage
