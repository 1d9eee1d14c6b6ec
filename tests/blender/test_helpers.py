# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper objects stay out of the artist's sight, also where a rigged figure is appended to another file."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.scene.display_inputs import NATIVE, OCTAHEDRA
from gskin_addon.scene.node_builder import get_input, set_input
from gskin_addon.scene.node_groups import draws_native, find_display
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import write_weights


@pytest.fixture(autouse=True)
def registered():
    gskin_addon.register()
    yield
    gskin_addon.unregister()


@pytest.fixture
def rigged_file(tmp_path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng(2)
    cloud = clouds.random_cloud(200, 0)
    obj, armature = create_splat_object(cloud, "Figure"), rigs.make_chains(4, rng)
    write_weights(obj, armature, rigs.random_weights(cloud, 4, rng))
    path = tmp_path / "figure.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path


@pytest.mark.parametrize("link", [False, True])
def test_an_appended_figure_brings_nothing_that_shows(rigged_file, link):
    folder = f"{rigged_file}/Object/"
    bpy.ops.wm.append(filepath=folder + "Figure", directory=folder, filename="Figure", link=link)
    bpy.context.view_layer.update()
    shown = {obj.name for obj in bpy.context.scene.objects if obj.visible_get()}
    rendered = {obj.name for obj in bpy.context.scene.objects if not obj.hide_render}
    picked = {obj.name for obj in bpy.context.scene.objects if not obj.hide_select}
    assert shown <= {"Figure", "Rig"}
    assert rendered <= {"Figure", "Rig"}
    assert picked <= {"Figure", "Rig"}
    assert "Figure" in shown


def test_an_appended_figure_poses(rigged_file):
    folder = f"{rigged_file}/Object/"
    bpy.ops.wm.append(filepath=folder + "Figure", directory=folder, filename="Figure")
    obj, armature = bpy.data.objects["Figure"], bpy.data.objects["Rig"]
    rigs.random_pose(armature, np.random.default_rng(3))
    rigs.assert_same_pose(obj, armature)


def test_an_appended_figure_is_drawn(rigged_file):
    folder = f"{rigged_file}/Object/"
    bpy.ops.wm.append(filepath=folder + "Figure", directory=folder, filename="Figure")
    obj = bpy.data.objects["Figure"]
    if draws_native(obj):
        set_input(find_display(obj), NATIVE, False)
        bpy.context.view_layer.update()
    drawn = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    assert len(drawn.vertices) == 6 * int((read_cloud(obj).opacities >= 0.25).sum())
    assert get_input(find_display(obj), OCTAHEDRA) is not None
