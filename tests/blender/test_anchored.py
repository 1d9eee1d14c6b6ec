# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats that follow a proxy mesh in Blender, against numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import splat_clouds as clouds
from proxy_meshes import grid, tube

bpy = pytest.importorskip("bpy")

from rig_scenes import angles_between, place, posed_in_blender

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.anchoring import pose_anchored
from gskin_addon.core.rig.quaternion import matrix_to_quat, quat_multiply, quat_to_matrix
from gskin_addon.scene.anchored import anchor_to_mesh, proxy_of, read_anchors, read_mesh, release
from gskin_addon.scene.attributes import read_attribute, read_positions
from gskin_addon.scene.proxy_object import posed_anchored
from gskin_addon.scene.splat_object import create_splat_object, read_cloud


@pytest.fixture(autouse=True)
def empty():
    bpy.ops.wm.read_factory_settings(use_empty=True)


def make_mesh(verts, faces, name="Proxy"):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(verts.tolist(), [], [list(map(int, face)) for face in faces])
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def splats_on(verts, faces, count=400, spread=0.03, seed=0):
    rng = np.random.default_rng(seed)
    corner = verts[faces[rng.integers(0, len(faces), count)]]
    means = np.einsum("nk,nkd->nd", rng.dirichlet([1, 1, 1], count), corner) + rng.normal(0, spread, (count, 3))
    cloud = replace(clouds.random_cloud(count, 0, seed), means=means.astype(np.float32))
    return create_splat_object(cloud, "Splats")


def evaluated_splats(obj):
    """Positions, quaternions and scales in the object's own space."""
    bpy.context.view_layer.update()
    means, quats = posed_in_blender(obj)
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return means, quats, read_attribute(evaluated.data, "scale")


def posed_mesh(obj, proxy):
    evaluated = proxy.evaluated_get(bpy.context.evaluated_depsgraph_get())
    matrix = np.linalg.inv(np.array(obj.matrix_world)) @ np.array(proxy.matrix_world)
    return read_positions(evaluated.data) @ matrix[:3, :3].T + matrix[:3, 3]


def bend(proxy, rng, amount=0.02):
    """A shape key that bends, twists and shakes the mesh."""
    proxy.shape_key_add(name="Basis")
    key = proxy.shape_key_add(name="Bent")
    points = read_positions(proxy.data).astype(np.float64)
    x, y, z = points.T
    bent = np.stack([x - 0.1 * x * x, 1.3 * y + 0.2 * x * z, z + 0.5 * np.sin(x) - 0.2 * x * y], axis=1)
    bent += rng.normal(0, amount, bent.shape) * 0.2
    key.data.foreach_set("co", bent.astype(np.float32).ravel())
    key.value = 1.0


def assert_follows(obj, proxy, **how):
    """Blender against `pose_anchored`: positions 1e-5 of the size, covariances 1e-4 of each splat's own."""
    means, quats, scales = evaluated_splats(obj)
    rest = read_cloud(obj, world=False)
    anchors, verts, faces = read_anchors(obj)
    wanted = pose_anchored(rest, anchors, verts, posed_mesh(obj, proxy), faces, **how)
    matrix = np.array(obj.matrix_world, dtype=np.float64)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    there = wanted.means @ matrix[:3, :3].T + matrix[:3, 3]
    size = np.linalg.norm(np.ptp(there, axis=0))
    assert np.abs(means - there).max() < 1e-5 * size

    def covariance(q, s):
        axes = quat_to_matrix(q.astype(np.float64)) * s[:, None, :].astype(np.float64)
        return axes @ axes.transpose(0, 2, 1)

    turned = quat_multiply(matrix_to_quat(matrix[:3, :3] / scale), wanted.quats)
    should = covariance(turned, wanted.scales)
    error = np.linalg.norm(covariance(quats, scales) - should, axis=(1, 2)) / np.linalg.norm(should, axis=(1, 2))
    assert error.max() < 1e-5
    return angles_between(quats, turned), scales / wanted.scales, np.abs(means - there).max() / size, error.max()


def test_splats_follow_a_bent_mesh_with_rotation_and_shear():
    verts, faces = tube()
    proxy, obj = make_mesh(verts, faces), splats_on(verts, faces)
    anchors = anchor_to_mesh(obj, proxy)
    assert proxy_of(obj) == proxy
    means, _, scales = evaluated_splats(obj)
    np.testing.assert_allclose(means, read_cloud(obj).means, atol=1e-5)  # nothing moves by being anchored
    np.testing.assert_allclose(scales, read_cloud(obj).scales, rtol=1e-3)
    bend(proxy, np.random.default_rng(0))
    _, ratio, *errors = assert_follows(obj, proxy)
    print("anchored: position, covariance error", *errors, "clamped", anchors.clamped.sum())
    np.testing.assert_allclose(ratio, 1, atol=0.02)
    assert np.abs(evaluated_splats(obj)[2] / read_cloud(obj).scales - 1).max() > 0.1  # it did shear


def test_splats_on_a_larger_mesh_are_larger_in_all_directions():
    verts, faces = tube()
    proxy, obj = make_mesh(verts, faces), splats_on(verts, faces)
    anchor_to_mesh(obj, proxy)
    proxy.scale = (1.5, 1.5, 1.5)
    np.testing.assert_allclose(evaluated_splats(obj)[2] / read_cloud(obj).scales, 1.5, rtol=1e-3)
    assert_follows(obj, proxy)


def test_the_edges_alone_may_say_how_a_mesh_deforms():
    verts, faces = tube()
    proxy, obj = make_mesh(verts, faces), splats_on(verts, faces)
    anchor_to_mesh(obj, proxy, edges_only=True)
    bend(proxy, np.random.default_rng(0))
    assert_follows(obj, proxy, edges_only=True)
    there = posed_anchored(obj).scales
    np.testing.assert_allclose(np.sort(evaluated_splats(obj)[2]), np.sort(there), rtol=0.02)
    anchor_to_mesh(obj, proxy)
    assert np.abs(np.sort(posed_anchored(obj).scales) / np.sort(there) - 1).max() > 0.05


def test_objects_may_lie_anywhere_and_move_apart():
    verts, faces = tube()
    proxy, obj = make_mesh(verts / 2, faces), splats_on(verts, faces)
    place(proxy, (0, 0, 0), (0, 0, 0), 2.0)
    parent = bpy.data.objects.new("Parent", None)
    bpy.context.scene.collection.objects.link(parent)
    proxy.parent = obj.parent = parent
    place(parent, (3, -1, 2), (0.4, 1.0, -2.0), 0.7)
    anchor_to_mesh(obj, proxy)
    assert_follows(obj, proxy)
    place(proxy, (0.2, 0.1, 0.3), (0.3, 0, 0.5), 2.0)
    bend(proxy, np.random.default_rng(1))
    assert_follows(obj, proxy)


def test_an_armature_on_the_proxy_moves_the_splats_once():
    verts, faces = tube()
    proxy, obj = make_mesh(verts, faces), splats_on(verts, faces)
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for k in range(3):
        bone = armature.data.edit_bones.new(f"b{k}")
        bone.head, bone.tail = (k, 0, 0), (k + 1, 0, 0)
        bone.parent = armature.data.edit_bones.get(f"b{k - 1}")
    bpy.ops.object.mode_set(mode="OBJECT")
    for target in (proxy, obj):
        modifier = target.modifiers.new("Armature", "ARMATURE")
        modifier.object = armature
        points = read_positions(target.data)
        for k in range(3):
            group = target.vertex_groups.new(name=f"b{k}")
            for index, x in enumerate(points[:, 0].tolist()):
                group.add((index,), max(0.0, 1 - abs(x - k - 0.5)), "REPLACE")
    anchor_to_mesh(obj, proxy)
    armature.pose.bones["b1"].rotation_mode = "XYZ"
    armature.pose.bones["b1"].rotation_euler = (0.5, 0.2, 0.9)
    before = read_cloud(obj).means
    assert_follows(obj, proxy)
    assert np.abs(evaluated_splats(obj)[0] - before).max() > 0.5
    assert [m.type for m in obj.modifiers if m.type == "ARMATURE"] == []


def test_quads_flat_splats_and_open_sheets():
    verts, _ = grid(5)
    corner = (5 * np.arange(4)[:, None] + np.arange(4)).reshape(-1, 1)
    quads = corner + np.array([0, 5, 6, 1])
    proxy = make_mesh(verts, quads)
    faces = read_mesh(proxy)[1]
    assert len(faces) == 32
    obj = splats_on(verts, faces, spread=0.01)
    scales = read_attribute(obj.data, "scale").copy()
    scales[:50, 2] = 0
    scales[50:60] = 0
    obj.data.attributes["scale"].data.foreach_set("vector", scales.ravel())
    anchor_to_mesh(obj, proxy)
    proxy.shape_key_add(name="Basis")
    key = proxy.shape_key_add(name="Sheared")
    linear = np.array([[2.0, 0.6, 0], [0, 0.5, 0], [0, 0, 1]])
    key.data.foreach_set("co", (verts @ linear.T).astype(np.float32).ravel())
    key.value = 1.0
    _, quats, found = evaluated_splats(obj)
    assert np.isfinite(quats).all()
    assert found[:50, 2].max() < 1e-4 * found[:50].max()
    np.testing.assert_array_equal(found[50:60], 0)
    axes = quat_to_matrix(quats[60:]) * found[60:, None, :]
    rest = read_cloud(obj).select(slice(60, None))
    before = quat_to_matrix(rest.quats) * rest.scales[:, None, :]
    wanted = linear @ before @ before.transpose(0, 2, 1) @ linear.T
    size = np.linalg.norm(wanted, axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1) / size, wanted / size, atol=1e-4)


def test_a_changed_topology_leaves_the_splats_at_rest_and_release_frees_them():
    verts, faces = tube(rings=9, sides=7)
    proxy, obj = make_mesh(verts, faces), splats_on(verts, faces, 100)
    anchor_to_mesh(obj, proxy)
    proxy.modifiers.new("Subdivision", "SUBSURF")
    rest = read_cloud(obj)
    means, _, scales = evaluated_splats(obj)
    np.testing.assert_array_equal(means.astype(np.float32), rest.means)
    np.testing.assert_array_equal(scales, rest.scales)
    with pytest.raises(InputError, match=r"'Proxy' has modifiers that change its points"):
        anchor_to_mesh(obj, proxy)
    release(obj)
    assert proxy_of(obj) is None
    with pytest.raises(InputError, match="not anchored"):
        read_anchors(obj)


def test_what_cannot_be_anchored_to_is_named():
    verts, faces = tube(rings=9, sides=7)
    obj = splats_on(verts, faces, 100)
    with pytest.raises(InputError, match="'Splats' is no mesh to anchor to"):
        anchor_to_mesh(obj, obj)
    with pytest.raises(InputError, match="'Loose' has no faces"):
        anchor_to_mesh(obj, make_mesh(verts, [], "Loose"))
    with pytest.raises(InputError, match="'Far' does not fit the splats"):
        anchor_to_mesh(obj, make_mesh(verts * 50 + 10, faces, "Far"))


def test_the_operators_anchor_the_selection_and_release_it():
    import gskin_addon

    gskin_addon.register()
    try:
        verts, faces = tube(rings=9, sides=7)
        proxy, obj = make_mesh(verts, faces), splats_on(verts, faces, 100)
        context = bpy.context
        for other in context.view_layer.objects:
            other.select_set(False)
        obj.select_set(True)
        context.view_layer.objects.active = obj
        assert not bpy.ops.gskin.anchor_to_mesh.poll()  # no mesh is selected
        assert not bpy.ops.gskin.release_from_mesh.poll()
        proxy.select_set(True)
        assert bpy.ops.gskin.anchor_to_mesh() == {"FINISHED"}
        assert proxy_of(obj) == proxy
        bend(proxy, np.random.default_rng(0))
        assert_follows(obj, proxy)
        assert bpy.ops.gskin.anchor_to_mesh(keep_residual=False) == {"FINISHED"}
        assert not read_anchors(obj)[0].residual.any()
        assert_follows(obj, proxy)
        assert [m.name for m in obj.modifiers] == ["GSkin Anchor", "GSkin Display"]
        assert bpy.ops.gskin.release_from_mesh() == {"FINISHED"}
        assert proxy_of(obj) is None
        proxy.location.x = 90
        context.view_layer.update()
        with pytest.raises(RuntimeError, match="does not fit the splats"):
            bpy.ops.gskin.anchor_to_mesh()
    finally:
        gskin_addon.unregister()
