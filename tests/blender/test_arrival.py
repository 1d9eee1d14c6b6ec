# SPDX-License-Identifier: GPL-3.0-or-later
"""What an artist meets when splats arrive: which way is up, where they stand, and how the rest of the scene looks."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.splats.axes import UP_AXES, rotate_cloud, up_rotation
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.ply import write_ply
from gskin_addon.scene import names, views
from gskin_addon.scene.placement import offset_of, up_of
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import write_weights
from gskin_addon.session.running_job import end, state

BIKER = clouds.ASSETS / "splats" / "pc_biker.ply"
RIG = clouds.ASSETS / "splats" / "pc_biker_rig.glb"


@pytest.fixture(autouse=True)
def registered():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    yield
    gskin_addon.unregister()


def figure(count=6000, seed=0) -> SplatCloud:
    """A body 2 m tall and off the origin, on two broad feet, Z up, with strays far below."""
    rng = np.random.default_rng(seed)
    cloud = clouds.random_cloud(count, 1, seed)
    body = rng.uniform((-0.2, -0.12, 0.1), (0.2, 0.12, 1.8), (count, 3))
    feet = rng.uniform((-0.3, -0.25, 0.0), (0.3, 0.25, 0.08), (count, 3))
    head = rng.uniform((-0.08, -0.08, 1.8), (0.08, 0.08, 2.0), (count, 3))
    kind = rng.choice(3, count, p=[0.6, 0.25, 0.15])[:, None]
    cloud.means[:] = np.where(kind == 0, body, np.where(kind == 1, feet, head)) + np.array([3.0, -2.0, 5.0])
    cloud.means[:5, 2] -= 40
    cloud.opacities[:] = 0.9
    return cloud


def arrive(tmp_path, cloud, **options):
    write_ply(tmp_path / "figure.ply", cloud)
    assert bpy.ops.gskin.import_splats(filepath=str(tmp_path / "figure.ply"), **options) == {"FINISHED"}
    return bpy.context.view_layer.objects.active


def solid_view():
    space = next(s for a in bpy.context.screen.areas for s in a.spaces if s.type == "VIEW_3D")
    return space.shading


@pytest.mark.parametrize("up", UP_AXES)
def test_the_up_axis_is_guessed_and_kept(tmp_path, up):
    cloud = figure()
    obj = arrive(tmp_path, rotate_cloud(cloud, up_rotation(up).T))
    assert up_of(obj) == up
    np.testing.assert_allclose(read_cloud(obj).means, cloud.means, atol=1e-4)


def test_a_script_moves_nothing(tmp_path):
    obj = arrive(tmp_path, figure())
    assert tuple(obj.location) == (0, 0, 0)
    assert names.OFFSET not in obj


def test_placed_on_the_floor_and_back(tmp_path):
    cloud = figure()
    obj = arrive(tmp_path, cloud, place=True)
    np.testing.assert_array_equal(read_cloud(obj, world=False).means, cloud.means)
    placed = read_cloud(obj).means[5:]
    np.testing.assert_allclose([placed[:, 2].min(), *np.median(placed, axis=0)[:2]], 0.0, atol=0.03)
    np.testing.assert_allclose(obj.location, offset_of(obj))
    assert bpy.ops.gskin.undo_placement() == {"FINISHED"}
    np.testing.assert_allclose(obj.location, 0.0, atol=1e-6)
    assert not bpy.ops.gskin.undo_placement.poll()
    assert bpy.ops.gskin.place_on_floor() == {"FINISHED"}
    np.testing.assert_allclose(read_cloud(obj).means[5:], placed, atol=1e-5)


def test_a_rig_for_the_files_coordinates(tmp_path):
    obj = arrive(tmp_path, figure(), place=True)
    armature = rigs.make_chains(3, np.random.default_rng(0))
    armature.location = (3, -2, 5)
    bpy.context.view_layer.objects.active = obj
    assert bpy.ops.gskin.move_rig_to_splats() == {"FINISHED"}
    np.testing.assert_allclose(armature.location, np.array([3, -2, 5]) + offset_of(obj), atol=1e-5)


def test_splats_around_a_rig_are_not_moved(tmp_path):
    armature = rigs.make_chains(3, np.random.default_rng(0))
    armature.location = (3, -2, 5)
    bpy.context.view_layer.update()
    obj = arrive(tmp_path, figure(), place=True)
    assert names.OFFSET not in obj
    assert tuple(obj.location) == (0, 0, 0)


@pytest.mark.parametrize("to", UP_AXES)
def test_turning_up(tmp_path, to):
    cloud = figure()
    obj = arrive(tmp_path, cloud, up="y", place=True)
    assert bpy.ops.gskin.turn_up(up=to) == {"FINISHED"}
    wanted = rotate_cloud(cloud, up_rotation(to))
    own = read_cloud(obj, world=False)
    np.testing.assert_allclose(own.means, wanted.means, atol=1e-4)
    assert rigs.angles_between(own.quats.astype(float), wanted.quats.astype(float)).max() < 1e-3
    np.testing.assert_allclose(own.sh, wanted.sh, atol=1e-4)
    assert up_of(obj) == to
    assert abs(np.percentile(read_cloud(obj).means[:, 2], 0.5)) < 0.05


def test_bound_splats_are_not_turned():
    rng = np.random.default_rng(1)
    cloud = clouds.random_cloud(30, 0)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(3, rng)
    write_weights(obj, armature, rigs.random_weights(cloud, 3, rng))
    bpy.context.view_layer.objects.active = obj
    for operator in (lambda: bpy.ops.gskin.turn_up(up="y"), bpy.ops.gskin.place_on_floor):
        with pytest.raises(RuntimeError, match="'S' follows 'Rig'"):
            operator()
    np.testing.assert_array_equal(read_cloud(obj).means, cloud.means)


@pytest.mark.skipif(not BIKER.is_file(), reason="no assets")
def test_a_real_capture_beside_its_rig():
    from gskin_addon.scene.rig_files import import_armature

    armature = import_armature(RIG, None)
    assert bpy.ops.gskin.import_splats(filepath=str(BIKER), place=True) == {"FINISHED"}
    obj = bpy.context.view_layer.objects.active
    assert up_of(obj) == "-y"
    assert tuple(obj.location) == (0, 0, 0)
    assert armature.name in bpy.context.scene.objects


def test_other_objects_keep_their_look(tmp_path):
    shading = solid_view()
    before = shading.color_type, shading.light, shading.show_object_outline
    bpy.ops.mesh.primitive_cube_add()
    arrive(tmp_path, figure())
    assert (shading.color_type, shading.light, shading.show_object_outline) == before
    bpy.ops.gskin.show_splat_colors()
    assert (shading.color_type, shading.light, shading.show_object_outline) == ("VERTEX", "FLAT", False)
    bpy.ops.gskin.show_splat_colors(show=False)
    assert (shading.color_type, shading.light, shading.show_object_outline) == before


def test_alone_splats_show_their_colours(tmp_path):
    arrive(tmp_path, figure())
    assert solid_view().color_type == "VERTEX"
    assert not views.has_other_surfaces(bpy.context.view_layer)


def test_bone_shapes_that_an_importer_put_away_are_nothing_to_look_at():
    """Else splats that arrive after a rig would not be framed."""
    bpy.ops.mesh.primitive_ico_sphere_add()
    ball, layer = bpy.context.object, bpy.context.view_layer
    assert views.has_surfaces(layer)
    away = bpy.data.collections.new("glTF_not_exported")
    bpy.context.scene.collection.children.link(away)
    away.objects.link(ball)
    bpy.context.scene.collection.objects.unlink(ball)
    layer.layer_collection.children[away.name].hide_viewport = True
    layer.update()
    assert not views.has_surfaces(layer)


def test_a_chosen_colour_mode_stays(tmp_path):
    solid_view().color_type = "RANDOM"
    arrive(tmp_path, figure())
    assert solid_view().color_type == "RANDOM"


def test_huge_splats_are_not_cut_off(tmp_path):
    cloud = figure()
    cloud.means[:] *= 5000
    space = next(s for a in bpy.context.screen.areas for s in a.spaces if s.type == "VIEW_3D")
    obj = arrive(tmp_path, cloud, frame=True)
    assert space.clip_end >= 5 * max(obj.dimensions) > 1000


def test_an_outcome_ends_with_its_file():
    end("Skinned 'S'", failed=True, details="trace")
    bpy.ops.wm.read_homefile(use_empty=True)
    assert (state.outcome, state.failed, state.details) == ("", False, "")


def test_a_running_job_outlives_the_load_handler():
    state.job, state.outcome = object(), "half way"
    try:
        bpy.ops.wm.read_homefile(use_empty=True)
        assert state.outcome == "half way"
    finally:
        end("")
