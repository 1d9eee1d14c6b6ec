# SPDX-License-Identifier: GPL-3.0-or-later
"""How splats are drawn: the viewport's mesh, the render's instances, and a picture."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

from pictures import read_picture

import gskin_addon
from gskin_addon.core.rig.colors import heat_colors, weight_colors
from gskin_addon.core.rig.lbs import sparsify
from gskin_addon.core.rig.quaternion import quat_to_matrix
from gskin_addon.core.splats.cloud import SH_C0, SplatCloud
from gskin_addon.scene import names
from gskin_addon.scene.attributes import read_attribute, read_positions
from gskin_addon.scene.display_inputs import NATIVE, OCTAHEDRA
from gskin_addon.scene.display_nodes import VIEWPORT_SIGMAS
from gskin_addon.scene.materials import viewport_material
from gskin_addon.scene.native_nodes import has_native_splats
from gskin_addon.scene.node_builder import get_input, set_input
from gskin_addon.scene.node_groups import (
    add_display,
    display_group,
    display_steps,
    find_display,
    get_display,
    renew_display,
    set_display,
)
from gskin_addon.scene.octahedra import ensure_octahedra, octahedra_count, octahedron
from gskin_addon.scene.render import clear_flecks, has_flecks, prepare_scene, render_still
from gskin_addon.scene.splat_object import create_splat_object as create_as_shown_first
from gskin_addon.scene.weights import write_weights

CORNERS = 6


@pytest.fixture(autouse=True)
def empty():
    bpy.ops.wm.read_factory_settings(use_empty=True)


def create_splat_object(cloud, name):
    """Splats drawn as ellipsoids: Blender 5.3 and later draw their own at first (see `test_native_display.py`)."""
    obj = create_as_shown_first(cloud, name)
    if has_native_splats():
        set_display(obj, NATIVE, False)
    return obj


def drawn(obj):
    return obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data


def linear(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def test_viewport_ellipsoids_have_place_shape_and_colour():
    cloud = clouds.random_cloud(40, 1)
    obj = create_splat_object(cloud, "S")
    set_display(obj, "Minimum Opacity", 0.0)
    set_display(obj, "Size", 2.0)
    mesh = drawn(obj)
    corners = read_positions(mesh).reshape(40, CORNERS, 3)
    np.testing.assert_allclose(corners.mean(axis=1), cloud.means, atol=1e-5)
    # Opposite corners of the octahedron lie on the splat's axes.
    half = (corners[:, 0::2] - corners[:, 1::2]) / 2
    axes = quat_to_matrix(cloud.quats).transpose(0, 2, 1) * cloud.scales[:, :, None] * 2.0 * VIEWPORT_SIGMAS
    np.testing.assert_allclose(half, axes, atol=1e-5)
    color = read_attribute(mesh, names.COLOR).reshape(40, CORNERS, 4)[:, 0]
    np.testing.assert_allclose(color[:, :3], linear(cloud.base_colors().astype(float)), atol=1e-5)
    np.testing.assert_allclose(color[:, 3], cloud.opacities, atol=1e-6)


def test_solid_mode_finds_the_colours():
    mesh = drawn(create_splat_object(clouds.random_cloud(10, 0), "S"))
    assert mesh.color_attributes.active_color_name == names.COLOR
    assert [m.name for m in mesh.materials] == ["GSkin Splats (Viewport)"]


def test_no_spherical_harmonics_on_the_drawn_mesh():
    mesh = drawn(create_splat_object(clouds.random_cloud(10, 4), "S"))
    assert not [a.name for a in mesh.attributes if a.name.startswith("radiance")]


def test_limit_opacity_and_switch():
    cloud = clouds.random_cloud(1000, 0)
    obj = create_splat_object(cloud, "S")
    set_display(obj, "Minimum Opacity", 0.7)
    assert len(drawn(obj).vertices) == CORNERS * int((cloud.opacities >= np.float32(0.7)).sum())
    set_display(obj, "Minimum Opacity", 0.0)
    set_display(obj, "Viewport Limit", 300)
    centres = read_positions(drawn(obj)).reshape(-1, CORNERS, 3).mean(axis=1)
    assert len(centres) == 300
    np.testing.assert_allclose(centres, cloud.means[np.floor(np.arange(300) * (1000 / 300)).astype(int)], atol=1e-5)
    set_display(obj, "Display", False)
    assert get_display(obj, "Display") is False
    assert len(drawn(obj).vertices) == 1000


def test_colours_by_bones_and_by_weights():
    rng = np.random.default_rng(4)
    cloud = clouds.random_cloud(50, 0)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(7, rng)
    set_display(obj, "Minimum Opacity", 0.0)
    weights = sparsify(rigs.random_weights(cloud, 7, rng), 4)
    write_weights(obj, armature, weights)

    def colors():
        return read_attribute(drawn(obj), names.COLOR).reshape(50, CORNERS, 4)[:, 0, :3]

    np.testing.assert_allclose(colors(), linear(cloud.base_colors().astype(float)), atol=1e-5)
    set_display(obj, "Show Bones", True)
    np.testing.assert_allclose(colors(), linear(weight_colors(weights)), atol=1e-4)
    set_display(obj, "Show Weights Of", "bone.003")
    shown, weight = colors(), weights[:, 3]
    np.testing.assert_allclose(shown[weight == 0], np.tile([0, 0, 1], ((weight == 0).sum(), 1)), atol=1e-5)
    order = np.argsort(weight)
    red_over_blue = (shown[:, 0] - shown[:, 2])[order]
    assert (np.diff(red_over_blue) >= -1e-6).all()
    assert red_over_blue[-1] > red_over_blue[0]


def test_colours_by_confidence():
    rng = np.random.default_rng(5)
    cloud = clouds.random_cloud(50, 0)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(3, rng)
    set_display(obj, "Minimum Opacity", 0.0)
    set_display(obj, "Show Confidence", True)
    confidence = rng.random(50).astype(np.float32)
    weights = rigs.random_weights(cloud, 3, rng)
    write_weights(obj, armature, weights, confidence=confidence)
    shown = read_attribute(drawn(obj), names.COLOR).reshape(50, CORNERS, 4)[:, 0, :3]
    np.testing.assert_allclose(shown, linear(heat_colors(1 - confidence)), atol=1e-4)
    write_weights(obj, armature, weights)
    assert names.CONFIDENCE not in obj.data.attributes


def test_borrowed_faces_are_those_made_anew():
    """The kept octahedra give the very mesh that instancing gives, settings and all."""
    obj = create_splat_object(clouds.random_cloud(500, 0), "S")
    set_display(obj, "Viewport Limit", 300)
    set_display(obj, "Size", 1.5)
    modifier = find_display(obj)
    helper = get_input(modifier, OCTAHEDRA)

    def shown():
        mesh = drawn(obj)
        corners = np.empty(len(mesh.loops), np.int32)
        mesh.loops.foreach_get("vertex_index", corners)
        return read_positions(mesh), read_attribute(mesh, names.COLOR), corners

    assert octahedra_count(helper) * CORNERS == len(shown()[0])
    borrowed = shown()
    set_input(modifier, OCTAHEDRA, None)
    for one, other in zip(borrowed, shown(), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)
    set_input(modifier, OCTAHEDRA, ensure_octahedra(octahedra_count(helper) + 1))
    for one, other in zip(borrowed, shown(), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_settings_of_the_panel_bring_other_octahedra():
    gskin_addon.register()
    try:
        cloud = clouds.random_cloud(400, 0)
        obj = create_splat_object(cloud, "S")
        modifier = find_display(obj)
        set_input(modifier, "Minimum Opacity", 0.6)  # as the panel does, without `set_display`
        bpy.context.view_layer.update()
        seen = int((cloud.opacities >= np.float32(0.6)).sum())
        assert octahedra_count(get_input(modifier, OCTAHEDRA)) == seen
        assert len(drawn(obj).vertices) == CORNERS * seen
        set_input(modifier, "Minimum Opacity", 2.0)
        bpy.context.view_layer.update()
        assert len(drawn(obj).vertices) == 0
    finally:
        gskin_addon.unregister()


def test_a_bound_figure_still_borrows_its_faces():
    """What keeps a frame with the display within three times the rig's cost: `benchmarks/bench_display.py`."""
    rng = np.random.default_rng(6)
    cloud = clouds.random_cloud(4_000, 0)
    cloud.opacities[:] = 0.9
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(20, rng)
    write_weights(obj, armature, rigs.random_weights(cloud, 20, rng))
    rigs.random_pose(armature, rng)
    assert octahedra_count(get_input(find_display(obj), OCTAHEDRA)) == 4_000


def test_one_group_and_one_modifier_however_often():
    first = create_splat_object(clouds.random_cloud(5, 0), "A")
    second = create_splat_object(clouds.random_cloud(5, 0), "B")
    add_display(first)
    assert len(first.modifiers) == 1
    assert first.modifiers[0].node_group == second.modifiers[0].node_group
    kinds = [group["gskin_group"] for group in bpy.data.node_groups]
    assert len(kinds) == len(set(kinds))
    assert kinds.count(find_display(first).node_group["gskin_group"]) == 1
    assert len(bpy.data.materials) == 2


def test_the_nodes_are_built_in_small_slices():
    """Blender looks at a whole tree after each node and link, so that one tree of 470 nodes took it a second."""
    most, steps = 0, display_steps()
    before = 0
    for _ in steps:
        now = sum(len(group.nodes) for group in bpy.data.node_groups)
        most, before = max(most, now - before), now
    assert max(len(group.nodes) for group in bpy.data.node_groups) <= 100
    assert 0 < most <= 100
    assert sum(len(group.nodes) for group in bpy.data.node_groups) - before <= 100
    places = [tuple(node.location) for node in display_group().nodes]
    assert len(set(places)) == len(places), "nodes lie upon one another"


def test_an_import_that_ends_early_leaves_no_display_half_built():
    steps = display_steps()
    next(steps)
    steps.close()
    whole = create_splat_object(clouds.random_cloud(5, 0), "S")
    assert len(drawn(whole).polygons) > 0


def test_octahedra_of_an_older_file_get_the_present_material():
    """They were opaque: renewed displays kept drawing translucent splats so."""
    obj = create_splat_object(clouds.random_cloud(5, 0), "S")
    mesh, present = octahedron(), viewport_material()
    older = bpy.data.materials.new("GSkin Splats (Viewport)")
    older["gskin_material"], older["gskin_version"] = "GSkin Splats (Viewport)", 1
    mesh.materials[0] = older
    renew_display(obj)
    assert [*mesh.materials] == [present]
    assert [material.original for material in drawn(obj).materials] == [present]


def test_raised_bounces_never_fall():
    scene = bpy.context.scene
    prepare_scene(scene)
    assert scene.cycles.transparent_max_bounces == 256
    scene.cycles.transparent_max_bounces = 500
    prepare_scene(scene)
    assert scene.cycles.transparent_max_bounces == 500


def test_views_get_the_samples_that_dithered_splats_need():
    eevee = bpy.context.scene.eevee
    for before, after in ((16, 32), (64, 64), (0, 0)):
        eevee.taa_samples = before
        prepare_scene(bpy.context.scene)
        assert eevee.taa_samples == (after if has_native_splats() else before)


def test_flecks_are_cleared_where_cycles_renders_and_never_brought_back():
    scene = bpy.context.scene
    scene.render.engine = "BLENDER_WORKBENCH"
    assert not has_flecks(scene)
    scene.render.engine = "CYCLES"
    assert has_flecks(scene)
    clear_flecks(scene)
    assert scene.cycles.min_transparent_bounces == 64
    assert not has_flecks(scene)
    scene.cycles.min_transparent_bounces = 100
    clear_flecks(scene)
    assert scene.cycles.min_transparent_bounces == 100


@pytest.fixture
def studio():
    """A camera that looks along +y at the origin, orthographic, 2 m wide, on a white world."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("C", bpy.data.cameras.new("C"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.location, camera.rotation_euler = (0, -5, 0), (np.pi / 2, 0, 0)
    camera.data.type, camera.data.ortho_scale = "ORTHO", 2.0
    scene.world = bpy.data.worlds.new("W")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (1, 1, 1, 1)
    return scene


def test_a_render_shows_gaussians(studio, tmp_path):
    """Two splats, one turned before the other: alpha and order against the formula, pixel by pixel."""
    quats = np.array([[1, 0, 0, 0], [np.cos(0.3), 0, np.sin(0.3), 0]], np.float32)
    scales = np.array([[0.3, 0.2, 0.1], [0.1, 0.05, 0.25]], np.float32)
    means = np.array([[0.1, 0.5, 0.1], [-0.1, -0.5, 0]], np.float32)
    opacity = np.array([0.9, 0.6], np.float32)
    srgb = np.array([[0.8, 0.2, 0.1], [0.1, 0.3, 0.9]])
    sh = ((srgb - 0.5) / SH_C0)[:, None].astype(np.float32)
    create_splat_object(SplatCloud(means, quats, scales, opacity, sh), "S")
    path = tmp_path / "shot.png"
    before = studio.render.resolution_x
    render_still(studio, path, size=(64, 64), samples=32)
    assert studio.render.resolution_x == before
    image = read_picture(path) / 255.0

    x, z = np.meshgrid((np.arange(64) + 0.5) / 32 - 1, 1 - (np.arange(64) + 0.5) / 32)
    wanted = np.ones((64, 64, 3))
    for splat in (0, 1):  # far to near
        axes = quat_to_matrix(quats[splat].astype(float)) * scales[splat]
        flat = np.linalg.inv((axes @ axes.T)[np.ix_([0, 2], [0, 2])])
        off = np.stack([x - means[splat, 0], z - means[splat, 2]], axis=-1)
        alpha = opacity[splat] * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", off, flat, off))
        wanted += alpha[..., None] * (linear(srgb[splat]) - wanted)
    shown = np.where(wanted <= 0.0031308, wanted * 12.92, 1.055 * wanted ** (1 / 2.4) - 0.055)
    assert np.abs(image - shown).mean() < 0.01
    assert np.abs(image - shown).max() < 0.12


def test_rendering_draws_the_pose(studio, tmp_path):
    """No Python between frames: a splat that a bone carries is elsewhere in the next frame's picture."""
    rng = np.random.default_rng(2)
    cloud = SplatCloud(
        np.zeros((1, 3)), np.array([[1, 0, 0, 0]]), np.full((1, 3), 0.1), np.ones(1), np.full((1, 1, 3), -2.0)
    )
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(2, rng)
    write_weights(obj, armature, np.array([[1.0, 0.0]]))
    bone = armature.pose.bones[0]
    bone.keyframe_insert("location", frame=1)
    bone.matrix = armature.matrix_world.inverted() @ bone.matrix
    bone.location.x += 0.6
    bone.keyframe_insert("location", frame=2)
    darkest = []
    for frame in (1, 2):
        studio.frame_set(frame)
        render_still(studio, tmp_path / f"{frame}.png", size=(40, 40), samples=4)
        image = read_picture(tmp_path / f"{frame}.png") @ (0.299, 0.587, 0.114)
        darkest.append(np.array(np.unravel_index(image.argmin(), image.shape)))
    assert np.linalg.norm(darkest[1] - darkest[0]) > 4


def test_posing_with_display_stays_fluent():
    """100,000 splats, 50 bones: drawing them makes a pose about four times as dear, whatever the machine's day.

    Seconds belong to docs/benchmarks.md: the same code took 0.06 and 0.14 s of processor time on two days.
    """
    rng = np.random.default_rng(1)
    cloud = clouds.random_cloud(100_000, 0)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(50, rng)
    write_weights(obj, armature, rigs.random_weights(cloud, 50, rng))
    rigs.random_pose(armature, rng)
    set_display(obj, "Display", False)
    bare = rigs.pose_change_cost(armature, "bone.020")
    set_display(obj, "Display", True)
    drawn_too = rigs.pose_change_cost(armature, "bone.020")
    print(f"one pose change, 100,000 splats: {bare:.3f} s of processor time, drawn {drawn_too:.3f} s")
    assert drawn_too < 30 * bare
