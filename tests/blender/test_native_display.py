# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's own Gaussian splats (5.3 and later) made of the posed mesh, against numpy."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.splats.cloud import SH_C0, SplatCloud
from gskin_addon.scene import names
from gskin_addon.scene.attributes import read_attribute, read_positions
from gskin_addon.scene.display_inputs import BY_SHADER, NATIVE
from gskin_addon.scene.native_nodes import NUDGE, has_native_splats
from gskin_addon.scene.node_builder import set_input
from gskin_addon.scene.node_groups import find_display, get_display, set_display
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.rotation_nodes import find_rotation
from gskin_addon.scene.splat_object import create_splat_object, read_cloud, to_world
from gskin_addon.scene.viewport import handler, switch
from gskin_addon.scene.weights import write_weights
from gskin_addon.session import readiness

pytestmark = pytest.mark.skipif(not has_native_splats(), reason="needs Blender 5.3 or later, which draws splats itself")

COUNT, BONES = 400, 7
NUDGED = np.array([1.0 + NUDGE, 1.0, 1.0 - NUDGE])


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture(autouse=True)
def empty():
    bpy.ops.wm.read_factory_settings(use_empty=True)


def rigged(rng, degree: int):
    """Splats that hang on an armature, both with a transform of their own, in a strong pose."""
    cloud = clouds.random_cloud(COUNT, degree)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(BONES, rng)
    rigs.place(armature, (1, 2, 0.3), (0.3, 0.4, 0.5), 1.7)
    rigs.place(obj, (0.5, -0.2, 0.3), (0.1, 0.9, -0.5), 0.7)
    write_weights(obj, armature, rigs.random_weights(cloud, BONES, rng))
    rigs.random_pose(armature, rng, 0.8)
    return obj, armature


def native_cloud(obj, depsgraph=None) -> SplatCloud:
    """What Blender draws, in the object's space."""
    geometry = obj.evaluated_get(depsgraph or bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    points = geometry.pointcloud
    assert points.type == "GAUSSIAN_SPLAT"
    base = read_attribute(points, names.BASE)
    rest = [read_attribute(points, names.SH.format(k)) for k in range(15)]
    sh = np.stack([base[:, :3], *(values for values in rest if values is not None)], axis=1)
    return SplatCloud(
        read_positions(points), read_attribute(points, names.ROTATION), read_attribute(points, names.SCALE),
        base[:, 3], sh,
    )  # fmt: skip


def assert_same_splats(shown: SplatCloud, wanted: SplatCloud) -> None:
    size = np.linalg.norm(np.ptp(wanted.means, axis=0))
    assert np.abs(shown.means - wanted.means).max() < 1e-6 * size
    assert rigs.angles_between(shown.quats.astype(float), wanted.quats.astype(float)).max() < 5e-6
    np.testing.assert_allclose(shown.scales, wanted.scales * NUDGED, rtol=1e-5)
    np.testing.assert_allclose(shown.opacities, wanted.opacities, atol=1e-7)
    np.testing.assert_allclose(shown.sh, wanted.sh[:, :16], atol=2e-5)  # of coefficients up to 4


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_posed_native_splats_are_those_of_numpy(rng, degree):
    """Positions, rotations and turned harmonics; Blender draws degrees up to 3."""
    obj, _ = rigged(rng, degree)
    wanted = posed_cloud(obj)
    assert np.abs(wanted.sh - read_cloud(obj).sh).max() > (1.0 if degree else -1.0)  # the pose turns harmonics
    assert_same_splats(to_world(native_cloud(obj), obj), wanted)


def test_splats_without_a_rig_are_as_they_are():
    cloud = clouds.random_cloud(50, 3)
    obj = create_splat_object(cloud, "S")
    shown = native_cloud(obj)
    assert_same_splats(shown, cloud)
    np.testing.assert_array_equal(shown.sh, cloud.sh)


def test_harmonics_turn_by_every_rotation(rng):
    """Also by those where two of the three angles have no direction: none, half turns, turns about one axis."""
    cloud = clouds.random_cloud(60, 3)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(1, rng)
    write_weights(obj, armature, np.ones((60, 1), np.float32))
    bone = armature.pose.bones[0]
    bone.rotation_mode = "QUATERNION"
    for turn in [*np.eye(4), (1, 1, 0, 0), (1, 0, 1, 0), (1, 0, 0, -1), (0, 1, 1, 0), (1, 1e-6, -1e-6, 0)]:
        rest = bone.bone.matrix_local.to_quaternion()
        quaternion = type(rest)(turn).normalized()
        bone.rotation_quaternion = rest.inverted() @ quaternion @ rest
        bpy.context.view_layer.update()
        assert_same_splats(native_cloud(obj), posed_cloud(obj))


def test_it_plays_without_python(rng):
    """Pose and frame change reach the native splats through the modifiers alone."""
    obj, armature = rigged(rng, 2)
    bone = armature.pose.bones[0]
    for frame, quaternion in ((1, (1, 0, 0, 0)), (10, (0.5, 0.5, 0.5, 0.5))):
        bone.rotation_quaternion = quaternion
        bone.keyframe_insert("rotation_quaternion", frame=frame)
    shown = []
    for frame in (1, 10):
        bpy.context.scene.frame_set(frame)
        assert_same_splats(to_world(native_cloud(obj), obj), posed_cloud(obj))
        shown.append(native_cloud(obj).sh)
    assert np.abs(shown[0] - shown[1]).max() > 0.1


def views():
    """The 3D views of the window."""
    areas = bpy.context.window_manager.windows[0].screen.areas
    return [area.spaces.active for area in areas if area.type == "VIEW_3D"]


def test_the_shader_draws_in_solid_mode_and_blender_elsewhere(rng, monkeypatch):
    """The viewport gives bare points where the shader draws; renders have Blender's own splats all the same."""
    bpy.ops.wm.read_factory_settings()
    obj, _ = rigged(rng, 1)
    gskin_addon.register()
    try:
        monkeypatch.setattr(switch, "wanted", switch.setting)
        assert views()
        switch.apply_to_all()
        assert switch.is_drawn(obj)
        assert len(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.edges) == 1
        for kind in ("RENDERED", "MATERIAL"):
            views()[0].shading.type = kind
            assert switch.is_out_of_date()
            handler._follow_views()
            assert not switch.is_out_of_date()
            assert not switch.is_drawn(obj)
            assert_same_splats(to_world(native_cloud(obj), obj), posed_cloud(obj))
            views()[0].shading.type = "SOLID"
            assert switch.is_out_of_date()
            handler._follow_views()
            assert switch.is_drawn(obj)
        set_display(obj, NATIVE, False)
        views()[0].shading.type = "RENDERED"
        switch.apply_to_all()
        assert switch.is_drawn(obj), "there are no splats of Blender's to give way to"
    finally:
        gskin_addon.unregister()


def test_a_render_has_native_splats_while_the_shader_draws_the_view(rng):
    """Of the nodes alone: what an object that bakes the render's geometry would see."""
    obj, _ = rigged(rng, 0)
    set_input(find_display(obj), BY_SHADER, True)
    bpy.context.view_layer.update()
    assert obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry().pointcloud is None
    group = find_display(obj).node_group
    viewport = next(node for node in group.nodes if node.bl_idname == "GeometryNodeIsViewport")
    for link in list(viewport.outputs[0].links):
        place = link.to_socket
        group.links.remove(link)
        place.default_value = 0  # as a render has it
    assert_same_splats(to_world(native_cloud(obj), obj), posed_cloud(obj))


def test_colours_by_bones_are_seen_from_everywhere(rng):
    obj, _ = rigged(rng, 1)
    set_display(obj, "Show Bones", True)
    shown = native_cloud(obj)
    assert shown.sh_degree == 0
    assert ((shown.base_colors() > -1e-6) & (shown.base_colors() < 1 + 1e-6)).all()
    set_display(obj, "Show Bones", False)
    set_display(obj, "Show Weights Of", "bone.002")
    index = obj.vertex_groups["bone.002"].index
    without = [not any(g.group == index and g.weight > 0 for g in v.groups) for v in obj.data.vertices]
    assert 0 < sum(without) < COUNT
    blue = (np.array([0, 0, 1]) - 0.5) / SH_C0
    np.testing.assert_allclose(native_cloud(obj).sh[without, 0], np.tile(blue, (sum(without), 1)), atol=1e-4)


def test_size_and_the_other_display():
    cloud = clouds.random_cloud(30, 0)
    obj = create_splat_object(cloud, "S")
    assert get_display(obj, NATIVE) is True
    set_display(obj, "Size", 2.0)
    np.testing.assert_allclose(native_cloud(obj).scales, 2 * cloud.scales * NUDGED, rtol=1e-5)
    set_display(obj, NATIVE, False)
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    assert evaluated.evaluated_geometry().pointcloud is None
    assert len(evaluated.data.polygons) > 0
    set_display(obj, "Display", False)
    assert len(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.vertices) == 30


def test_one_far_splat_is_told():
    """Blender divides the extent of all splats evenly, so that one far off makes the places of all others coarse."""
    gskin_addon.register()
    try:
        cloud = clouds.random_cloud(300, 0)
        obj, _ = create_splat_object(cloud, "S"), rigs.make_chains(3, np.random.default_rng(0))
        bpy.context.scene.gskin.splats = obj

        def told() -> list[str]:
            return [check.operator for check in readiness.checks(bpy.context) if check.name == "Far Splats"]

        assert not told()
        obj.data.vertices[150].co = (1e6, 0, 0)
        readiness.forget()
        assert told() == ["gskin.clean_splats"]
        set_display(obj, NATIVE, False)
        readiness.forget()
        assert not told()
    finally:
        gskin_addon.unregister()


def test_a_display_of_an_older_file_is_renewed_with_its_rotation_nodes(rng):
    """Without the bones' turn the harmonics would stay behind."""
    obj, _ = rigged(rng, 1)
    gskin_addon.register()
    try:
        bpy.context.scene.gskin.splats = obj
        for modifier in (find_display(obj), find_rotation(obj)):
            old = modifier.node_group.copy()
            old["gskin_version"] = 1
            modifier.node_group = old
        old_display, old_rotation = find_display(obj).node_group, find_rotation(obj).node_group
        for item in list(old_display.interface.items_tree):
            if item.name in (NATIVE, BY_SHADER):
                old_display.interface.remove(item)
        assert bpy.ops.gskin.renew_display() == {"FINISHED"}
        assert find_display(obj).node_group != old_display
        assert find_rotation(obj).node_group != old_rotation
        assert_same_splats(to_world(native_cloud(obj), obj), posed_cloud(obj))
    finally:
        gskin_addon.unregister()
