# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's choices for *Render Splats*: `scene.gskin_render`. All else are Blender's own output settings."""

from __future__ import annotations

from typing import Any

import bpy


class GSkinRender(bpy.types.PropertyGroup):
    hold_out: bpy.props.BoolProperty(
        name="Behind Other Objects",
        description="Meshes and other surfaces that a render shows hide the splats behind them, as if opaque",
        default=True,
    )
    on_gpu: bpy.props.BoolProperty(
        name="Graphics Card",
        description="Draw by the shader of the 3D view where no depth is wanted. Blender stands still for the time of "
        "a redraw",
        default=False,
    )
    depth: bpy.props.BoolProperty(
        name="Depth",
        description="Also write how far the splats are, in metres along the camera's axis: as channel Z of an OpenEXR "
        "file, else as a file ..._depth.exr beside the picture",
        default=False,
    )


CLASSES = (GSkinRender,)


def render_settings(scene: bpy.types.Scene) -> GSkinRender:
    """The scene's choices."""
    scenes: Any = scene
    settings: GSkinRender = scenes.gskin_render
    return settings


def register() -> None:
    scenes: Any = bpy.types.Scene
    scenes.gskin_render = bpy.props.PointerProperty(type=GSkinRender)


def unregister() -> None:
    scenes: Any = bpy.types.Scene
    del scenes.gskin_render
