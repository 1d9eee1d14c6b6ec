# SPDX-License-Identifier: GPL-3.0-or-later
"""Captured colours are changed by view transforms; one click shows them as they are, and nothing else does."""

from __future__ import annotations

import pytest

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.scene.render import changes_colors


@pytest.fixture(autouse=True)
def registered():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    yield
    gskin_addon.unregister()


def test_a_click_shows_colours_as_captured():
    scene = bpy.context.scene
    assert scene.view_settings.view_transform == "AgX"  # Blender's own default
    assert changes_colors(scene)
    scene.view_settings.exposure = 0.5
    assert bpy.ops.gskin.standard_view() == {"FINISHED"}
    assert (scene.view_settings.view_transform, scene.view_settings.look) == ("Standard", "None")
    assert scene.view_settings.exposure == 0.5  # the artist's
    assert not changes_colors(scene)
    assert not bpy.ops.gskin.standard_view.poll()
