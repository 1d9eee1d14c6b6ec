# SPDX-License-Identifier: GPL-3.0-or-later
"""Selecting bad splats and cleaning them away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.splats.cleanup import find_needles
from gskin_addon.scene.splat_object import create_splat_object, is_splat_object, read_cloud, replace_cloud

BAD = [7, 30, 31]


@pytest.fixture
def splats():
    """A slab of 600 splats with degree 1; two strays, one faint giant, one needle; a vertex group."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    cloud = clouds.random_cloud(600, 1)
    rng = np.random.default_rng(0)
    means = rng.uniform(0, 1, (600, 3)) * (1, 1, 0.05)
    scales = np.tile([0.02, 0.03, 0.001], (600, 1))
    opacities = np.full(600, 0.8)
    means[[7, 30]] = (0.5, 0.5, 2), (4, 0, 0)
    scales[31], opacities[31] = 0.5, 0.05
    scales[40, 0] = 0.6
    obj = create_splat_object(replace(cloud, means=means, scales=scales, opacities=opacities), "Slab")
    bpy.context.view_layer.objects.active = obj
    group = obj.vertex_groups.new(name="bone")
    for index in range(600):
        group.add([index], index / 600, "REPLACE")
    yield obj
    if bpy.context.object and bpy.context.object.mode == "EDIT":
        bpy.ops.object.mode_set(mode="OBJECT")
    gskin_addon.unregister()


def selected(obj):
    bpy.ops.object.mode_set(mode="OBJECT")
    return [vertex.index for vertex in obj.data.vertices if vertex.select]


def test_bad_splats_are_selected_in_edit_mode(splats):
    assert bpy.ops.gskin.select_bad_splats() == {"FINISHED"}
    assert splats.mode == "EDIT"
    assert selected(splats) == BAD


def test_selecting_again_from_edit_mode_and_only_what_is_asked_for(splats):
    bpy.ops.gskin.select_bad_splats()
    assert bpy.ops.gskin.select_bad_splats(strays=False, faint_giants=False, needle_ratio=10) == {"FINISHED"}
    assert selected(splats) == [40]


def check_rest(obj, before, kept):
    after = read_cloud(obj)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name)[kept], name)
    assert [round(v.groups[0].weight * 600) for v in obj.data.vertices] == list(kept)


def test_removing_leaves_the_others_as_they_were(splats):
    before = read_cloud(splats)
    assert bpy.ops.gskin.clean_splats(action="REMOVE") == {"FINISHED"}
    check_rest(splats, before, np.setdiff1d(np.arange(600), BAD))
    assert [obj for obj in bpy.data.objects if is_splat_object(obj)] == [splats]


def test_put_aside_splats_come_back_by_join(splats):
    before = read_cloud(splats)
    assert bpy.ops.gskin.clean_splats() == {"FINISHED"}
    aside = bpy.data.objects["Slab Aside"]
    assert aside.hide_get()
    assert aside.hide_render
    assert is_splat_object(aside)
    check_rest(splats, before, np.setdiff1d(np.arange(600), BAD))
    check_rest(aside, before, np.array(BAD))
    aside.hide_set(False)
    aside.select_set(True)
    splats.select_set(True)
    bpy.context.view_layer.objects.active = splats
    bpy.ops.object.join()
    check_rest(splats, before, np.append(np.setdiff1d(np.arange(600), BAD), BAD))


def test_a_clean_object_makes_no_second_one(splats):
    bpy.ops.gskin.clean_splats(action="REMOVE")
    assert bpy.ops.gskin.clean_splats() == {"FINISHED"}
    assert "Slab Aside" not in bpy.data.objects


def test_needles_are_widened_and_balls_are_balls(splats):
    assert bpy.ops.gskin.clean_splats(strays=False, faint_giants=False, max_aspect=5) == {"FINISHED"}
    cloud = read_cloud(splats)
    assert cloud.count == 600
    assert not find_needles(cloud, 5.01).any()
    bpy.ops.gskin.clean_splats(strays=False, faint_giants=False, balls=True)
    assert np.ptp(read_cloud(splats).scales, axis=1).max() == 0


def test_an_impossible_ratio_is_named(splats):
    with pytest.raises(RuntimeError, match="at least 1"):
        bpy.ops.gskin.clean_splats(max_aspect=0.5)
    assert read_cloud(splats).count == 600


@pytest.mark.parametrize("action", ["ASIDE", "REMOVE"])
def test_where_every_splat_is_bad_nothing_is_done_and_that_is_said(splats, action):
    cloud = read_cloud(splats)
    haze = replace(cloud, scales=np.full_like(cloud.scales, 1.0), opacities=np.full(600, 0.05, np.float32))
    replace_cloud(splats, haze)
    before = read_cloud(splats)
    words = "All 600 splats of 'Slab' are strays or faint giants, so nothing was changed.*switch off"
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.gskin.clean_splats(action=action, balls=True)
    np.testing.assert_array_equal(read_cloud(splats).quats, before.quats)
    assert "Slab Aside" not in bpy.data.objects


def test_clean_waits_for_object_mode(splats):
    bpy.ops.object.mode_set(mode="EDIT")
    assert not bpy.ops.gskin.clean_splats.poll()
