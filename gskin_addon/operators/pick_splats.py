# SPDX-License-Identifier: GPL-3.0-or-later
"""A click on splats that the viewport's shader draws selects their object; Blender itself finds nothing there."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

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
        # Blender's own selection has had its turn, on pressing the button.
        return getattr(context.window_manager.keyconfigs.active.preferences, "select_mouse", "LEFT") == "LEFT"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self.extend and context.selected_objects:
            return {"PASS_THROUGH"}
        shown, camera, region = shown_objects(context), context.region_data, context.region
        number = pick(
            [one.splats for one in shown], np.array(camera.view_matrix), np.array(camera.window_matrix),
            (region.height, region.width), (event.mouse_region_x + 0.5, region.height - event.mouse_region_y - 0.5),
        )  # fmt: skip
        if number is None or shown[number].obj.hide_select:
            return {"PASS_THROUGH"}
        obj = shown[number].obj
        obj.select_set(not (self.extend and obj.select_get() and obj == context.view_layer.objects.active))
        context.view_layer.objects.active = obj
        return {"FINISHED"}


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
