# SPDX-License-Identifier: GPL-3.0-or-later
"""Render Splats, below GSkin's panel."""

from __future__ import annotations

import bpy

from ..scene.render import has_flecks
from ..scene.scene_camera import image_size
from ..session.chosen import chosen_splats
from ..session.render_settings import render_settings
from ..session.running_job import state


class GSKIN_PT_render(bpy.types.Panel):
    bl_idname = "GSKIN_PT_render"
    bl_label = "Render"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "GSkin"
    bl_parent_id = "GSKIN_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return chosen_splats(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        scene, layout = context.scene, self.layout
        settings = render_settings(scene)
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.enabled = state.job is None
        column.prop(scene, "camera")
        column.prop(scene.render, "filepath", text="Output")
        column.prop(scene.render, "film_transparent", text="Transparent")
        column.prop(settings, "hold_out")
        column.prop(settings, "depth")
        column.prop(settings, "on_gpu")
        if settings.on_gpu and settings.depth:
            column.label(text="With Depth the processor draws", icon="INFO")
        width, height = image_size(scene)
        note = layout.row()
        note.active = False
        note.label(text=f"{width} x {height}, {scene.render.image_settings.file_format.replace('_', ' ')}")
        if has_flecks(scene):
            layout.operator("gskin.clear_flecks", icon="SHADING_RENDERED")
        row = layout.row(align=True)
        row.operator("gskin.render_splats", text="Render Splats", icon="RENDER_STILL")
        row.operator("gskin.render_splats", text="Animation", icon="RENDER_ANIMATION").animation = True


CLASSES = (GSKIN_PT_render,)
