# SPDX-License-Identifier: GPL-3.0-or-later
"""A click on splats that the viewport's shader draws selects their object; Blender itself finds nothing there."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from bpy_extras import view3d_utils

from ..core.render.picking import pick
from ..scene.viewport.visible import shown_objects

_items: list[tuple[Any, Any]] = []


class GSKIN_OT_pick_splats(bpy.types.Operator):
    """Select the object whose splats are under the mouse"""

    bl_idname = "gskin.pick_splats"
    bl_label = "Select Splats Under Mouse"
    bl_options = {"UNDO", "INTERNAL"}

    extend: bpy.props.BoolProperty(name="Extend", description="Keep what is selected", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT" or context.region_data is None or context.region is None:
            return False
        return getattr(context.window_manager.keyconfigs.active.preferences, "select_mouse", "LEFT") == "LEFT"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        shown, camera, region = shown_objects(context), context.region_data, context.region
        at = event.mouse_region_x, event.mouse_region_y
        found = pick(
            [one.splats for one in shown], np.array(camera.view_matrix), np.array(camera.window_matrix),
            (region.height, region.width), (at[0] + 0.5, region.height - at[1] - 0.5),
        )  # fmt: skip
        if found is None or shown[found[0]].obj.hide_select:
            return {"PASS_THROUGH"}
        # What Blender itself finds there goes first, as bones in front, unless it is a surface behind the splats.
        before = set(context.selected_objects)
        bpy.ops.view3d.select(location=at, toggle=self.extend, deselect_all=not self.extend)
        after = set(context.selected_objects)
        others = after ^ before if self.extend else after
        if others and not (len(others) == 1 and _is_behind(context, next(iter(others)), at, found[1])):
            return {"FINISHED"}
        obj = shown[found[0]].obj
        for other in others:
            other.select_set(self.extend and other in before)
        obj.select_set(not (self.extend and obj in before))
        context.view_layer.objects.active = obj
        return {"FINISHED"}


def _is_behind(context: bpy.types.Context, obj: bpy.types.Object, at: tuple[int, int], depth: float) -> bool:
    """Whether the first surface at a place of the region is the object's, and farther than `depth` metres."""
    if obj.show_in_front:
        return False
    region, camera = context.region, context.region_data
    start = view3d_utils.region_2d_to_origin_3d(region, camera, at)
    along = view3d_utils.region_2d_to_vector_3d(region, camera, at)
    hit, place, _, _, found, _ = context.scene.ray_cast(context.view_layer.depsgraph, start, along)
    return bool(hit) and found.original == obj and -(camera.view_matrix @ place).z > depth


CLASSES = (GSKIN_OT_pick_splats,)


def register() -> None:
    keys = bpy.context.window_manager.keyconfigs.addon
    if keys is None:  # in the background
        return
    keymap = keys.keymaps.new(name="Object Mode", space_type="EMPTY")
    for shift in (False, True):
        item = keymap.keymap_items.new("gskin.pick_splats", "LEFTMOUSE", "CLICK", shift=shift)
        item.properties.extend = shift
        _items.append((keymap, item))


def unregister() -> None:
    for keymap, item in _items:
        keymap.keymap_items.remove(item)
    _items.clear()
