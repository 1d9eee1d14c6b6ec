# SPDX-License-Identifier: GPL-3.0-or-later
"""Below GSkin's panel: a skeleton to begin with, fitted or from another program."""

from __future__ import annotations

import bpy

from ..session.chosen import chosen_splats
from ..session.running_job import state


class GSKIN_PT_skeleton(bpy.types.Panel):
    bl_idname = "GSKIN_PT_skeleton"
    bl_label = "Skeleton"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "GSkin"
    bl_parent_id = "GSKIN_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return chosen_splats(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.enabled = state.job is None
        for operator in ("gskin.fit_human", "gskin.fit_quadruped", "gskin.fit_bird"):
            column.operator(operator, icon="OUTLINER_OB_ARMATURE")
        row = column.row(align=True)
        row.operator_menu_enum("gskin.mark_landmark", "name", icon="EMPTY_AXIS")
        row.operator("gskin.clear_landmarks", text="", icon="X")
        column.operator("gskin.import_skeleton", text="Import Skeleton...", icon="IMPORT")


CLASSES = (GSKIN_PT_skeleton,)
