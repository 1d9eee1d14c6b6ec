# SPDX-License-Identifier: GPL-3.0-or-later
"""The GSkin tab in the 3D view's side bar."""

from __future__ import annotations

import bpy

from ..core.guidance import NO_GUIDANCE
from ..session.chosen import chosen_armature, chosen_splats, panel_settings
from ..session.estimate import expected_time
from ..session.properties import GSkinSettings
from ..session.running_job import state
from . import arrival, check_list, guidance, progress
from .job_presets import GSKIN_PT_job_presets
from .translations import BUTTON, tr


class GSKIN_PT_main(bpy.types.Panel):
    bl_idname = "GSKIN_PT_main"
    bl_label = "GSkin"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "GSkin"

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        GSKIN_PT_job_presets.draw_panel_header(self.layout)

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
        if settings.proxy is not None:
            column.prop(settings, "edges_only")
        if settings.splats is None or settings.armature is None:
            self._draw_chosen(context, column)
        arrival.draw(context, column)
        self._draw_settings(settings, column)

        if state.job is None:
            check_list.draw(context, layout)
            row = layout.row()
            row.scale_y = 1.6
            time = expected_time(context)
            text = tr("Auto-Skin Gaussians", BUTTON)
            text = f"{text} ({time.replace('about', tr('about'))})" if time else text
            row.operator("gskin.auto_skin", text=text, icon="MOD_ARMATURE")
        progress.draw(layout, context.region.width if context.region is not None else 300)
        if state.job is None:
            splats = chosen_splats(context)
            progress.draw_posing(layout, splats)
            progress.draw_comparison(layout, splats)
            progress.draw_confidence(layout, splats)

    def _draw_settings(self, settings: GSkinSettings, layout: bpy.types.UILayout) -> None:
        """How the weights are made, folded away: the defaults are good."""
        header, body = layout.panel("gskin_settings", default_closed=True)
        header.label(text="Settings")
        if body is None:
            return
        body.prop(settings, "init")
        body.prop(settings, "guidance")
        guidance.draw(body, settings.models, settings.guidance)
        # What has no effect is not shown.
        if settings.guidance != NO_GUIDANCE:
            body.prop(settings, "preset")
            body.prop(settings, "seed")
        if settings.guidance != NO_GUIDANCE or settings.init == "visibility":
            body.prop(settings, "front")
        body.prop(settings, "max_influences")
        body.prop(settings, "paintable")

    def _draw_chosen(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Say which objects the selection stands for, where no object is named."""
        names = [obj.name for obj in (chosen_splats(context), chosen_armature(context)) if obj is not None]
        if names:
            row = layout.row()
            row.active = False
            row.label(text=tr("Selected: {names}").format(names=", ".join(names)))


CLASSES = (GSKIN_PT_main,)
