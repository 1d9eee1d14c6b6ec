# SPDX-License-Identifier: GPL-3.0-or-later
"""The GSkin tab in the 3D view's side bar."""

from __future__ import annotations

import bpy

from ..core.guidance import NO_GUIDANCE
from ..session.chosen import chosen_armature, chosen_splats, panel_settings
from ..session.readiness import what_is_missing
from ..session.running_job import state
from . import arrival, guidance, progress


class GSKIN_PT_main(bpy.types.Panel):
    bl_idname = "GSKIN_PT_main"
    bl_label = "GSkin"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "GSkin"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator("gskin.import_splats", icon="IMPORT")

        settings = panel_settings(context)
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.enabled = state.job is None
        column.prop(settings, "splats", icon="OUTLINER_OB_POINTCLOUD")
        column.prop(settings, "armature", icon="OUTLINER_OB_ARMATURE")
        column.prop(settings, "proxy", icon="OUTLINER_OB_MESH")
        if settings.splats is None or settings.armature is None:
            self._draw_chosen(context, column)
        arrival.draw(context, column)
        column.separator()
        column.prop(settings, "init")
        column.prop(settings, "guidance")
        guidance.draw(column, settings.models, settings.guidance)
        # What has no effect is not shown.
        if settings.guidance != NO_GUIDANCE:
            column.prop(settings, "preset")
            column.prop(settings, "seed")
        if settings.guidance != NO_GUIDANCE or settings.init == "visibility":
            column.prop(settings, "front")
        column.prop(settings, "max_influences")

        if state.job is None:
            row = layout.row()
            row.scale_y = 1.4
            row.operator("gskin.auto_skin", icon="MOD_ARMATURE")
            problem = what_is_missing(context)
            if problem:
                self._draw_wrapped(context, layout, problem)
        progress.draw(layout, context.region.width)

    def _draw_chosen(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Say which objects the selection stands for, where no object is named."""
        names = [obj.name for obj in (chosen_splats(context), chosen_armature(context)) if obj is not None]
        if names:
            row = layout.row()
            row.active = False
            row.label(text="Selected: " + ", ".join(names))

    def _draw_wrapped(self, context: bpy.types.Context, layout: bpy.types.UILayout, text: str) -> None:
        column = layout.column(align=True)
        column.active = False
        for part in progress.wrap(text, context.region.width):
            column.label(text=part)


CLASSES = (GSKIN_PT_main,)
