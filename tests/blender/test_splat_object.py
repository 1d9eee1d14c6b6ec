# SPDX-License-Identifier: GPL-3.0-or-later
"""Clouds to Blender objects and back."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.quaternion import quat_to_matrix
from gskin_addon.core.splats.axes import rotate_cloud
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.ply import read_ply, write_ply
from gskin_addon.core.splats.sh import eval_sh
from gskin_addon.scene.splat_object import create_splat_object, is_splat_object, read_cloud, replace_cloud


@pytest.fixture(autouse=True)
def empty():
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.parametrize("degree", range(5))
def test_values_come_back_exactly(degree):
    cloud = clouds.random_cloud(300, degree)
    back = read_cloud(create_splat_object(cloud, "S"))
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
    np.testing.assert_allclose(back.quats, cloud.quats, atol=1e-7)


def test_attributes_are_those_of_native_splats():
    cloud = clouds.random_cloud(10, 1)
    mesh = create_splat_object(cloud, "S").data
    kinds = {name: mesh.attributes[name].data_type for name in ("rotation", "scale", "radiance:base", "radiance:sh_0")}
    assert kinds == {
        "rotation": "QUATERNION",
        "scale": "FLOAT_VECTOR",
        "radiance:base": "FLOAT_COLOR",
        "radiance:sh_0": "FLOAT_VECTOR",
    }
    np.testing.assert_array_equal(mesh.attributes["radiance:base"].data[3].color[:3], cloud.sh[3, 0])
    np.testing.assert_array_equal(mesh.attributes["radiance:sh_0"].data[3].vector, cloud.sh[3, 1])
    assert "radiance:sh_3" not in mesh.attributes


def test_extra_columns_are_kept_and_survive_a_file(tmp_path):
    rng = np.random.default_rng(1)
    extra = {
        "nx": rng.normal(size=20).astype(np.float32),
        "label": rng.integers(-5, 5, 20).astype(np.int16),
        "position": rng.integers(0, 255, 20).astype(np.uint8),
    }
    create_splat_object(replace(clouds.random_cloud(20, 0), extra=extra), "S")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "s.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "s.blend"))
    back = read_cloud(bpy.data.objects["S"]).extra
    assert set(back) == set(extra)
    for name, values in extra.items():
        np.testing.assert_array_equal(back[name], values)


def test_world_space_looks_the_same_from_anywhere():
    cloud = clouds.random_cloud(200, 3)
    obj = create_splat_object(cloud, "S")
    obj.location, obj.rotation_euler, obj.scale = (1, -2, 3), (0.3, -1.1, 2.0), (0.5, 0.5, 0.5)
    world = read_cloud(obj)
    matrix = np.array(obj.matrix_world)
    rotation = matrix[:3, :3] / 0.5
    np.testing.assert_allclose(world.means, cloud.means @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5)

    def covariance(c: SplatCloud):
        axes = quat_to_matrix(c.quats.astype(np.float64)) * c.scales[:, None]
        return axes @ axes.transpose(0, 2, 1)

    np.testing.assert_allclose(
        covariance(world), matrix[:3, :3] @ covariance(cloud) @ matrix[:3, :3].T, rtol=1e-4, atol=1e-7
    )
    seen = np.random.default_rng(0).normal(size=(200, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    np.testing.assert_allclose(eval_sh(world.sh, seen @ rotation.T), eval_sh(cloud.sh, seen), atol=1e-4)
    np.testing.assert_array_equal(read_cloud(obj, world=False).means, cloud.means)


@pytest.mark.parametrize("scale", [(1, 1, 2), (-1, 1, 1), (0, 0, 0)])
def test_uneven_scale_is_refused_with_the_remedy(scale):
    obj = create_splat_object(clouds.random_cloud(5, 0), "Vase")
    obj.scale = scale
    with pytest.raises(InputError, match=r"'Vase'.*all three axes"):
        read_cloud(obj)


def test_other_objects_are_refused():
    mesh = bpy.data.meshes.new("M")
    other = bpy.data.objects.new("Cube", mesh)
    assert not is_splat_object(other)
    assert not is_splat_object(None)
    with pytest.raises(InputError, match="'Cube' is no splat object"):
        read_cloud(other)


def test_deleted_points_and_lost_attributes():
    obj = create_splat_object(clouds.random_cloud(50, 1), "S")
    bpy.context.view_layer.objects.active = obj
    obj.data.vertices.foreach_set("select", np.arange(50) < 20)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.delete(type="VERT")
    with pytest.raises(InputError, match="'S' is in Edit Mode"):
        read_cloud(obj)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert read_cloud(obj).count == 30
    obj.data.attributes.remove(obj.data.attributes["scale"])
    with pytest.raises(InputError, match="'S' has lost its splat attribute 'scale'"):
        read_cloud(obj)


def test_replacing_needs_the_same_number():
    obj = create_splat_object(clouds.random_cloud(5, 0), "S")
    other = clouds.random_cloud(5, 2, seed=3)
    replace_cloud(obj, other)
    np.testing.assert_array_equal(read_cloud(obj).sh, other.sh)
    with pytest.raises(InputError, match="has 5 splats and the new values are for 6"):
        replace_cloud(obj, clouds.random_cloud(6, 0))


def test_no_splats_is_an_error_and_one_is_fine():
    with pytest.raises(InputError, match="no splats"):
        create_splat_object(clouds.random_cloud(1, 0).select(slice(0, 0)), "S")
    obj = create_splat_object(clouds.random_cloud(1, 0), "S")
    bpy.context.evaluated_depsgraph_get()
    assert read_cloud(obj).count == 1


def test_a_hundred_thousand_splats_import_without_a_hang(tmp_path):
    path = tmp_path / "big.ply"
    write_ply(path, clouds.random_cloud(100_000, 3))
    began = time.process_time()
    cloud = rotate_cloud(read_ply(path).cloud, np.eye(3))
    create_splat_object(cloud, "S")
    bpy.context.view_layer.update()
    assert time.process_time() - began < 60
