# SPDX-License-Identifier: GPL-3.0-or-later
"""In GSkin's panel: what was assumed of the chosen splats when they arrived, and buttons to correct it."""

from __future__ import annotations

from typing import Any

import bpy

from ..scene import views
from ..scene.bone_frames import armature_of
from ..scene.placement import is_placed, shift_of, up_of
from ..session.chosen import chosen_armature, chosen_splats
from .translations import BUTTON, tr


def draw(context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
    """One line of what was assumed, and its buttons; nothing where no splats are chosen."""
    splats = chosen_splats(context)
    if splats is None:
        return
    placed = is_placed(splats)
    up = tr("{axis} up, on the floor") if placed else tr("{axis} up, where the file has it")
    layout.label(text=up.format(axis=up_of(splats).upper()))
    if armature_of(splats) is None:
        row = layout.row(align=True)
        row.operator_menu_enum("gskin.turn_up", "up", text="Turn")
        if placed:
            row.operator("gskin.undo_placement", text="", icon="LOOP_BACK")
        else:
            row.operator("gskin.place_on_floor", text="", icon="TRIA_DOWN_BAR")
        if shift_of(splats).any() and chosen_armature(context) is not None:
            layout.operator("gskin.move_rig_to_splats", icon="ARMATURE_DATA")
    space: Any = context.space_data
    if space is not None and space.type == "VIEW_3D" and space.shading.type == "SOLID":
        shown = views.shows_colors(space)
        text = tr("Hide Splat Colors", BUTTON) if shown else tr("Show Splat Colors", BUTTON)
        layout.operator("gskin.show_splat_colors", text=text, icon="COLOR").show = not shown

