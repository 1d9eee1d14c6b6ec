# SPDX-License-Identifier: GPL-3.0-or-later
"""Select Unsure Splats, and confidence in pictures of the command line."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.commands.render import _confidence_colors
from gskin_addon.core.errors import InputError
from gskin_addon.scene import names
from gskin_addon.scene.attributes import write_attribute
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import write_weights


@pytest.fixture
def splats():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    rng = np.random.default_rng(2)
    cloud = clouds.random_cloud(30, 0)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(3, rng)
    write_weights(
        obj, armature, rigs.random_weights(cloud, 3, rng), confidence=np.linspace(0, 1, 30, dtype=np.float32)
    )
    bpy.context.view_layer.objects.active = obj
    yield obj
    gskin_addon.unregister()


def test_selects_what_is_less_sure(splats):
    assert bpy.ops.gskin.select_unsure_splats(below=0.25) == {"FINISHED"}
    assert splats.mode == "EDIT"
    bpy.ops.object.mode_set(mode="OBJECT")
    selected = np.array([v.select for v in splats.data.vertices])
    np.testing.assert_array_equal(selected, np.linspace(0, 1, 30) < 0.25)


@pytest.mark.parametrize(("worst", "count"), [(0, 0), (10, 3), (50, 15), (100, 30)])
def test_selects_the_least_sure_part(splats, worst, count):
    assert bpy.ops.gskin.select_unsure_splats(worst=worst) == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    assert [v.select for v in splats.data.vertices] == [True] * count + [False] * (30 - count)


def test_of_equally_sure_splats_no_more_than_asked_for_are_selected(splats):
    write_attribute(splats.data, names.CONFIDENCE, "FLOAT", np.ones(30))
    assert bpy.ops.gskin.select_unsure_splats(worst=10) == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    assert sum(v.select for v in splats.data.vertices) == 3


def test_colours_run_from_red_to_blue(splats):
    colors = _confidence_colors(splats)
    np.testing.assert_allclose(colors[[0, -1]], [[1, 0, 0], [0, 0, 1]], atol=1e-6)


def test_weights_without_confidence_are_refused(splats):
    splats.data.attributes.remove(splats.data.attributes[names.CONFIDENCE])
    assert not bpy.ops.gskin.select_unsure_splats.poll()
    with pytest.raises(InputError, match="skin it again"):
        _confidence_colors(splats)
