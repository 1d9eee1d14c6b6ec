# SPDX-License-Identifier: GPL-3.0-or-later
"""Apply Transform (Ctrl-A) on splats: rotations, scales and spherical harmonics follow, through undo and files."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.scene import names
from gskin_addon.scene.follow_transforms import warning_of
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import write_weights


@pytest.fixture(autouse=True)
def registered():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    yield
    gskin_addon.unregister()


def placed(count=80, degree=2, scale=1.7):
    obj = create_splat_object(clouds.random_cloud(count, degree), "S")
    obj.data[names.MARK]["up"] = "-y"
    rigs.place(obj, (0.4, -0.2, 1.0), (0.3, 1.1, -0.7), scale)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    return obj


def apply(**kinds):
    wanted = {"location": False, "rotation": False, "scale": False, **kinds}
    assert bpy.ops.object.transform_apply(**wanted) == {"FINISHED"}
    bpy.context.view_layer.update()


def assert_same(cloud, wanted):
    size = np.ptp(wanted.means, axis=0).max()
    np.testing.assert_allclose(cloud.means, wanted.means, atol=1e-5 * size)
    assert rigs.angles_between(cloud.quats.astype(float), wanted.quats.astype(float)).max() < 1e-4
    np.testing.assert_allclose(cloud.scales, wanted.scales, rtol=1e-4)
    np.testing.assert_allclose(cloud.sh, wanted.sh, atol=1e-3)
    np.testing.assert_array_equal(cloud.opacities, wanted.opacities)


@pytest.mark.parametrize(
    "kinds",
    [
        {"rotation": True},
        {"scale": True},
        {"location": True},
        {"location": True, "rotation": True, "scale": True},
    ],
    ids=["rotation", "scale", "location", "all"],
)
def test_the_world_looks_the_same_after_apply(kinds):
    obj = placed()
    before = read_cloud(obj)
    apply(**kinds)
    assert_same(read_cloud(obj), before)
    assert not warning_of(obj)
    assert obj.data[names.MARK]["up"] == "-y"


def test_once_is_enough():
    obj = placed()
    apply(rotation=True, scale=True)
    after = read_cloud(obj, world=False)
    obj.location.x += 1
    bpy.context.view_layer.update()
    np.testing.assert_array_equal(read_cloud(obj, world=False).quats, after.quats)


def test_bound_splats_still_pose():
    rng = np.random.default_rng(1)
    cloud = clouds.random_cloud(60, 1)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(4, rng)
    rigs.place(obj, (0.1, 0.2, 0.0), (0.2, 0.5, 0.1), 1.3)
    write_weights(obj, armature, rigs.random_weights(cloud, 4, rng))
    before = read_cloud(obj)
    bpy.ops.object.select_all(action="DESELECT")
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    apply(rotation=True, scale=True)
    assert_same(read_cloud(obj), before)
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)


def test_undo_and_redo():
    obj = placed()
    before_world, before_own = read_cloud(obj), read_cloud(obj, world=False)
    bpy.ops.ed.undo_push(message="before")
    # As in the window: the operator's undo step is taken before the handlers run.
    bpy.ops.object.transform_apply(location=False, rotation=True, scale=True)
    bpy.ops.ed.undo_push(message="apply")
    bpy.context.view_layer.update()
    assert_same(read_cloud(bpy.data.objects["S"]), before_world)
    bpy.ops.ed.undo()
    assert_same(read_cloud(bpy.data.objects["S"], world=False), before_own)
    bpy.ops.ed.redo()
    bpy.context.view_layer.update()
    obj = bpy.data.objects["S"]
    assert tuple(obj.scale) == (1, 1, 1)
    assert_same(read_cloud(obj), before_world)
    bpy.ops.ed.undo()
    assert_same(read_cloud(bpy.data.objects["S"], world=False), before_own)


def test_a_file_saved_before_the_correction(tmp_path):
    obj = placed()
    before = read_cloud(obj)
    gskin_addon.unregister()  # a Blender without the add-on applied it
    bpy.ops.object.transform_apply(location=False, rotation=True, scale=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "s.blend"))
    gskin_addon.register()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "s.blend"))
    assert_same(read_cloud(bpy.data.objects["S"]), before)


@pytest.mark.parametrize("scale", [(1, 2, 1), (-1, 1, 1)])
def test_uneven_scale_is_told(scale):
    obj = placed()
    obj.scale = scale
    own = read_cloud(obj, world=False)
    apply(scale=True)
    assert "undo" in warning_of(obj)
    np.testing.assert_array_equal(read_cloud(obj, world=False).quats, own.quats)


def test_edits_of_single_splats_are_the_artists():
    obj = placed()
    own = read_cloud(obj, world=False)
    for vertex in list(obj.data.vertices)[::3]:
        vertex.co *= 1.5
    obj.data.update()
    bpy.context.view_layer.update()
    after = read_cloud(obj, world=False)
    np.testing.assert_array_equal(after.quats, own.quats)
    np.testing.assert_array_equal(after.scales, own.scales)
    assert not warning_of(obj)


def test_deleted_splats_change_nothing_else():
    obj = placed()
    bpy.ops.object.mode_set(mode="OBJECT")
    for vertex in obj.data.vertices:
        vertex.select = vertex.index < 20
    own = read_cloud(obj, world=False)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    np.testing.assert_allclose(read_cloud(obj, world=False).quats, own.quats[20:], atol=1e-6)
    before = read_cloud(obj)
    apply(rotation=True)
    assert_same(read_cloud(obj), before)
