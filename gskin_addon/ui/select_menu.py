# SPDX-License-Identifier: GPL-3.0-or-later
"""Selections of splats in Blender's own Select menus of Edit Mode and of Weight Paint's vertex selection."""

from __future__ import annotations

from typing import Any

import bpy

from ..scene.splat_object import is_splat_object

CLASSES = ()

MENUS = ("VIEW3D_MT_select_edit_mesh", "VIEW3D_MT_select_paint_mask_vertex")

OPERATORS = (
    "gskin.select_by_bone",
    "gskin.select_by_color",
    "gskin.grow_splat_selection",
    "gskin.shrink_splat_selection",
    "gskin.select_linked_splats",
    "gskin.select_in_front",
    "gskin.select_unsure_splats",
    "gskin.next_unsure_cluster",
)


def draw(self: Any, context: bpy.types.Context) -> None:
    """Below what Blender itself has, where splats are edited."""
    if is_splat_object(context.view_layer.objects.active):
        layout: bpy.types.UILayout = self.layout
        layout.separator()
        for operator in OPERATORS:
            layout.operator(operator)


def register() -> None:
    for name in MENUS:
        getattr(bpy.types, name).append(draw)


def unregister() -> None:
    for name in MENUS:
        getattr(bpy.types, name).remove(draw)
