# SPDX-License-Identifier: GPL-3.0-or-later
"""What 3D views do for splats: their colours in Solid mode, framing, and how far they see."""

from __future__ import annotations

from typing import Any

import bpy

from .helpers import is_helper
from .splat_object import is_splat_object

_SURFACES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"}
_BEFORE = "gskin_shading"


def has_surfaces(view_layer: bpy.types.ViewLayer) -> bool:
    """Whether there is anything to look at, splats or other. Bone shapes that an importer has put away are nothing."""
    return any(
        obj.type in _SURFACES and not is_helper(obj) and obj.visible_get(view_layer=view_layer)
        for obj in view_layer.objects
    )


def has_other_surfaces(view_layer: bpy.types.ViewLayer) -> bool:
    """Whether anything but splats is visible that Solid mode's colours would repaint."""
    return any(
        obj.type in _SURFACES
        and not is_splat_object(obj)
        and not is_helper(obj)
        and obj.visible_get(view_layer=view_layer)
        for obj in view_layer.objects
    )


def shows_colors(space: bpy.types.SpaceView3D) -> bool:
    """Whether Solid mode of this view shows the splats' colours."""
    return space.shading.color_type == "VERTEX"


def show_colors(screen: bpy.types.Screen | None, *, chosen_before: bool = True) -> None:
    """Let the screen's 3D views show colours as captured in Solid mode, where splats would all be grey.

    Solid mode finds the colours only as those of all objects: others become white where they have none. Lamps would
    shade splats a second time, and an outline would run around every gap between them. chosen_before: also where
    another kind of colour was chosen. `hide_colors` brings back what was there.
    """
    before = {}
    for key, space in _views(screen):
        shading = space.shading
        if shading.color_type == "MATERIAL" or (chosen_before and shading.color_type != "VERTEX"):
            before[key] = f"{shading.color_type} {shading.light} {int(shading.show_object_outline)}"
            shading.color_type, shading.light, shading.show_object_outline = "VERTEX", "FLAT", False
    if before:
        screen[_BEFORE] = before


def hide_colors(screen: bpy.types.Screen | None) -> None:
    """Give the screen's 3D views the look back that they had before `show_colors`; else Blender's own."""
    before = dict(screen.get(_BEFORE, {})) if screen is not None else {}
    for key, space in _views(screen):
        if shows_colors(space):
            color, light, outline = before.get(key, "MATERIAL STUDIO 1").split()
            space.shading.color_type, space.shading.light = color, light
            space.shading.show_object_outline = outline == "1"
    if before:
        del screen[_BEFORE]


def frame_selected(context: bpy.types.Context) -> None:
    """Let every 3D view of the screen show the selected objects as a whole, however large they are."""
    size = max((float(max(*obj.dimensions)) for obj in context.selected_objects), default=0.0)
    for area in context.screen.areas if context.screen else ():
        if area.type != "VIEW_3D":
            continue
        space: Any = area.spaces.active
        space.clip_end = max(space.clip_end, 10.0 * size)
        region = next((region for region in area.regions if region.type == "WINDOW"), None)
        if region is not None and context.window is not None and not bpy.app.background:
            with context.temp_override(window=context.window, area=area, region=region):
                bpy.ops.view3d.view_selected()


def _views(screen: bpy.types.Screen | None) -> list[tuple[str, bpy.types.SpaceView3D]]:
    """The screen's 3D views, hidden ones of an area included, by a key that stays."""
    return [
        (f"{i} {j}", space)
        for i, area in enumerate(screen.areas if screen else ())
        for j, space in enumerate(area.spaces)
        if space.type == "VIEW_3D"
    ]
