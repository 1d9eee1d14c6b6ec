# SPDX-License-Identifier: GPL-3.0-or-later
"""The ellipsoid display by the scene's camera: colours of harmonics, and discs that face it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

from gskin_addon.core.splats.sh import eval_sh
from gskin_addon.scene import names
from gskin_addon.scene.attributes import read_attribute, read_positions
from gskin_addon.scene.display_inputs import NATIVE, OCTAHEDRA
from gskin_addon.scene.node_builder import get_input, has_input, set_input
from gskin_addon.scene.node_groups import add_display, find_display, set_display
from gskin_addon.scene.octahedra import octahedra_count
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import write_weights

EYE = (1.5, -3.0, 2.0)


@pytest.fixture(autouse=True)
def camera():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(scene.camera)
    scene.camera.location = EYE
    return scene.camera


def shiny(degree, count=60):
    rng = np.random.default_rng(degree)
    sh = rng.normal(0, 0.3, (count, (degree + 1) ** 2, 3)).astype(np.float32)
    return replace(clouds.random_cloud(count, degree), sh=sh, opacities=np.full(count, 0.9, np.float32))


def as_ellipsoids(obj):
    if has_input(find_display(obj), NATIVE):
        set_display(obj, NATIVE, False)


def drawn_colors(obj):
    """sRGB of each splat as drawn in the viewport."""
    mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    linear = read_attribute(mesh, names.COLOR).reshape(-1, 6, 4)[:, 0, :3]
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def seen_from(cloud, eye):
    rays = cloud.means - np.asarray(eye, np.float32)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.clip(eval_sh(cloud.sh, rays.astype(np.float32)), 0, 1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("pose", [False, True])
def test_harmonics_are_seen_from_the_camera_and_turn_with_bones(degree, pose, camera):
    cloud = shiny(degree)
    obj = create_splat_object(cloud, "S")
    as_ellipsoids(obj)
    rigs.place(obj, (0.2, 0.1, -0.1), (0.4, -0.3, 0.9), 1.1)
    if pose:
        rng = np.random.default_rng(2)
        armature = rigs.make_chains(4, rng)
        write_weights(obj, armature, rigs.random_weights(cloud, 4, rng))
        rigs.random_pose(armature, rng)
    bpy.context.view_layer.update()
    wanted = seen_from(posed_cloud(obj), EYE)
    np.testing.assert_allclose(drawn_colors(obj), wanted, atol=2e-3)
    camera.location = (-2.0, 1.0, -4.0)
    bpy.context.view_layer.update()
    elsewhere = drawn_colors(obj)
    assert (np.abs(elsewhere - wanted).max() > 0.1) == (degree > 0)
    np.testing.assert_allclose(elsewhere, seen_from(posed_cloud(obj), camera.location), atol=2e-3)


def test_without_a_camera_the_constant_colours_are_shown(camera):
    cloud = shiny(2)
    obj = create_splat_object(cloud, "S")
    as_ellipsoids(obj)
    bpy.data.objects.remove(camera)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(drawn_colors(obj), cloud.base_colors(), atol=2e-3)


def rendered_instances(obj):
    """Matrices (N, 4, 4) and the mesh of what a render would draw, from the viewport's own evaluation."""
    modifier = find_display(obj)
    group = modifier.node_group
    viewport = next(node for node in group.nodes if node.bl_idname == "GeometryNodeIsViewport")
    for link in list(viewport.outputs[0].links):
        group.links.remove(link)
    bpy.context.view_layer.update()
    found = [
        (np.array(instance.matrix_world), instance.object.data)
        for instance in bpy.context.evaluated_depsgraph_get().object_instances
        if instance.is_instance
    ]
    return np.array([matrix for matrix, _ in found]), found[0][1]


def test_discs_lie_where_rays_from_the_camera_find_the_gaussian_densest():
    cloud = shiny(0, 30)
    obj = create_splat_object(cloud, "S")
    as_ellipsoids(obj)
    rigs.place(obj, (0.2, 0.1, -0.1), (0.4, -0.3, 0.9), 1.1)
    matrices, mesh = rendered_instances(obj)
    assert len(matrices) == cloud.count
    assert len(mesh.polygons) == 1
    cloud = read_cloud(obj)
    reach = np.sqrt(2 * np.log(0.9 * 64))
    for matrix, mean, quat, scale in zip(matrices, cloud.means, cloud.quats, cloud.scales, strict=True):
        np.testing.assert_allclose(matrix[:3, 3], mean, atol=1e-4)
        # The disc's unit circle lies on the ellipsoid: M M^T is the covariance, in a turned frame.
        w, x, y, z = quat
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])  # fmt: skip
        axes = reach * turn * scale
        linear = matrix[:3, :3]
        np.testing.assert_allclose(linear @ linear.T, axes @ axes.T, rtol=2e-3, atol=1e-6)
        # Along the ray through the centre the density falls off fastest across the disc: the ray is conjugate to it.
        ray = np.linalg.solve(linear, mean - np.array(EYE))
        np.testing.assert_allclose(ray[:2] / np.linalg.norm(ray), 0.0, atol=2e-3)
        assert ray[2] < 0  # its front faces the camera


def test_ellipsoids_can_be_had_again():
    obj = create_splat_object(shiny(0, 10), "S")
    as_ellipsoids(obj)
    set_display(obj, "Face Camera", False)
    matrices, mesh = rendered_instances(obj)
    assert len(matrices) == 10
    assert len(mesh.polygons) > 20


def test_faces_are_borrowed_as_before():
    obj = create_splat_object(shiny(3), "S")
    as_ellipsoids(obj)
    assert octahedra_count(get_input(find_display(obj), OCTAHEDRA)) == 60
    set_input(add_display(obj), OCTAHEDRA, None)
    bpy.context.view_layer.update()
    mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    assert len(read_positions(mesh)) == 6 * 60
