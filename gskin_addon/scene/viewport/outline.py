# SPDX-License-Identifier: GPL-3.0-or-later
"""The outline of selected splats, as Blender has it around other objects."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from .visible import Shown


def selected_objects(context: bpy.types.Context, shown: Sequence[Shown]) -> list[bool]:
    """For each object whether it gets an outline; none does where Blender outlines nothing."""
    overlay = getattr(context.space_data, "overlay", None)
    if context.mode != "OBJECT" or overlay is None or not (overlay.show_overlays and overlay.show_outline_selected):
        return [False] * len(shown)
    return [one.obj.select_get(view_layer=context.view_layer) for one in shown]


def outline_color(context: bpy.types.Context, objects: Sequence[bpy.types.Object]) -> tuple[float, float, float]:
    """The theme's colour (linear) for selected objects, that of the active one where it is among them."""
    theme = context.preferences.themes[0].view_3d
    active = context.view_layer.objects.active in objects
    srgb = np.array(theme.object_active if active else theme.object_selected, np.float64)[:3]
    red, green, blue = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).tolist()
    return red, green, blue
