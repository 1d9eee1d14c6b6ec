# SPDX-License-Identifier: GPL-3.0-or-later
"""Below GSkin's panel: how the chosen splats are drawn, and weights and files, and what cleans them up."""

from __future__ import annotations

import textwrap

import bpy

from ..scene import names
from ..scene.anchored import proxy_of
from ..scene.bone_frames import armature_of
from ..scene.display_colors import SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF
from ..scene.display_inputs import BY_SHADER, DISPLAY_INPUTS
from ..scene.fabric import has_fabric
from ..scene.handlers import is_seen_while_painted, is_unsettled
from ..scene.node_builder import has_input, input_property
from ..scene.node_groups import find_display
from ..scene.overlay import ALIKE, BONES, CONFIDENCE, NONE, WEIGHTS, is_of_before, overlay_of
from ..scene.render import changes_colors
from ..scene.viewport import switch
from ..session.chosen import chosen_splats
from ..session.running_job import state
from .translations import BUTTON, tr

_EDITS = (
    (("gskin.smooth_weights", "Smooth"), ("gskin.sharpen_weights", "Sharpen")),
    (("gskin.assign_to_bone", "To Bone"), ("gskin.flood_weights", "Flood")),
    (("gskin.follow_neighbours", "Follow Neighbours"), ("gskin.mirror_weights", "Mirror")),
)
"""Changes of the weights that are there, by operator and what its button says."""

_SELECTS = (
    (("gskin.select_by_bone", "By Bone"), ("gskin.select_by_color", "By Color")),
    (("gskin.grow_splat_selection", "Grow"), ("gskin.shrink_splat_selection", "Shrink")),
    (("gskin.select_linked_splats", "Linked"), ("gskin.select_in_front", "Front Side Only")),
)
"""Selections, in the same way."""


class _Child:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "GSkin"
    bl_parent_id = "GSKIN_PT_main"
    bl_options = {"DEFAULT_CLOSED"}


class GSKIN_PT_display(_Child, bpy.types.Panel):
    bl_idname = "GSKIN_PT_display"
    bl_label = "Display"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        return splats is not None and find_display(splats) is not None

    def draw(self, context: bpy.types.Context) -> None:
        splats = chosen_splats(context)
        modifier = find_display(splats)
        column = self.layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        _draw_true_splats(context, splats, column)
        if changes_colors(context.scene):
            column.operator("gskin.standard_view", icon="COLOR")
        column.prop(splats, "gskin_overlay")
        overlay = overlay_of(splats)
        _draw_timeliness(context, splats, overlay, column)
        if overlay == CONFIDENCE and names.CONFIDENCE not in splats.data.attributes:
            column.label(text="These weights do not know how sure they are", icon="INFO")
        if armature_of(splats) is not None:
            column.operator("gskin.show_moves_with", icon="EYEDROPPER")
        for name in DISPLAY_INPUTS:
            if not has_input(modifier, name) or name in {SHOW_BONES, SHOW_CONFIDENCE}:
                continue
            if name == SHOW_WEIGHTS_OF and overlay != WEIGHTS:
                continue
            owner, path = input_property(modifier, name)
            if name == SHOW_WEIGHTS_OF:
                column.prop_search(owner, path, splats, "vertex_groups", text=name)
            else:
                column.prop(owner, path, text=name)


def _draw_true_splats(context: bpy.types.Context, splats: bpy.types.Object, layout: bpy.types.UILayout) -> None:
    """The switch between splats and ellipsoids, and why there may be ellipsoids all the same."""
    layout.prop(context.scene, "gskin_draw_splats")
    if not switch.setting(context.scene):
        return
    if switch.failure:
        box = layout.box()
        box.alert = True
        box.label(text="Splats cannot be drawn; ellipsoids are:", icon="ERROR")
        for line in textwrap.wrap(switch.failure, 48)[:4]:
            box.label(text=line)
    elif not has_input(find_display(splats), BY_SHADER):
        layout.operator("gskin.renew_display", icon="FILE_REFRESH")


def _draw_timeliness(
    context: bpy.types.Context, splats: bpy.types.Object, overlay: str, layout: bpy.types.UILayout
) -> None:
    """While weights are worked on: what is seen of them, and of which weights it is."""
    if splats.mode == "WEIGHT_PAINT" and switch.setting(context.scene):
        row = layout.row()
        row.active = overlay != NONE
        row.prop(context.scene, "gskin_show_in_paint")
    if is_of_before(splats):
        layout.label(text="Measured with earlier weights; Try It again", icon="INFO")
    elif overlay in {BONES, ALIKE} and splats.mode == "EDIT":
        layout.label(text="Weights changed in Edit Mode show after it", icon="INFO")
    elif overlay in {BONES, ALIKE} and is_seen_while_painted(splats) and is_unsettled(splats):
        layout.label(text="Weights are read; colors follow", icon="SORTTIME")


class GSKIN_PT_select(_Child, bpy.types.Panel):
    bl_idname = "GSKIN_PT_select"
    bl_label = "Select"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return chosen_splats(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.enabled = state.job is None
        for pair in _SELECTS:
            row = column.row(align=True)
            for operator, text in pair:
                row.operator(operator, text=tr(text, BUTTON))
        if names.CONFIDENCE in chosen_splats(context).data.attributes:
            row = column.row(align=True)
            row.operator("gskin.select_unsure_splats", text=tr("Least Sure", BUTTON))
            row.operator("gskin.next_unsure_cluster", text="", icon="TRIA_LEFT").step = -1
            row.operator("gskin.next_unsure_cluster", text=tr("Worst Cluster", BUTTON)).step = 1
            row.operator("gskin.next_unsure_cluster", text="", icon="TRIA_RIGHT").step = 1


class GSKIN_PT_weights(_Child, bpy.types.Panel):
    bl_idname = "GSKIN_PT_weights"
    bl_label = "Weights"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return chosen_splats(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.enabled = state.job is None  # it would be about splats and weights that are no more
        row = column.row(align=True)
        row.operator("gskin.load_weights", text="Load...", icon="FILE_FOLDER")
        row.operator("gskin.save_weights", text="Save...", icon="FILE_TICK")
        column.operator("gskin.bind_to_armature", icon="LINKED")
        column.separator()
        for pair in _EDITS:
            row = column.row(align=True)
            for operator, text in pair:
                row.operator(operator, text=tr(text, BUTTON))
        row = column.row(align=True)
        row.operator("gskin.transfer_weights", icon="IMPORT")
        row.operator("gskin.transfer_weights_to_mesh", text="To Mesh", icon="EXPORT")
        row = column.row(align=True)
        row.operator("gskin.separate_parts", icon="MOD_EDGESPLIT")
        row.operator("gskin.select_seams", text="", icon="RESTRICT_SELECT_OFF")
        row.operator("gskin.clear_seams", text="", icon="X")
        column.operator("gskin.refine_selected", icon="MOD_ARMATURE")
        row = column.row(align=True)
        if chosen_splats(context).mode == "WEIGHT_PAINT" and not has_fabric(chosen_splats(context)):
            column.label(text="Brushes need a fabric under the splats", icon="INFO")
        row.operator("gskin.make_paintable", icon="WPAINT_HLT")
        row.operator("gskin.remove_fabric", text="", icon="X")
        column.separator()
        if proxy_of(chosen_splats(context)) is None:
            column.operator("gskin.anchor_to_mesh", icon="MESH_DATA")
        else:
            column.operator("gskin.release_from_mesh", icon="UNLINKED")


class GSKIN_PT_export(_Child, bpy.types.Panel):
    bl_idname = "GSKIN_PT_export"
    bl_label = "Export"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return chosen_splats(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.operator("gskin.export_glb", icon="EXPORT")


class GSKIN_PT_hygiene(_Child, bpy.types.Panel):
    bl_idname = "GSKIN_PT_hygiene"
    bl_label = "Clean Up"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return chosen_splats(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.enabled = state.job is None  # it would be about splats and weights that are no more
        column.operator("gskin.select_bad_splats", icon="RESTRICT_SELECT_OFF")
        column.operator("gskin.clean_splats", icon="BRUSH_DATA")


CLASSES = (GSKIN_PT_display, GSKIN_PT_select, GSKIN_PT_weights, GSKIN_PT_export, GSKIN_PT_hygiene)
