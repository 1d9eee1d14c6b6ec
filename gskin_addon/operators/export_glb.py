# SPDX-License-Identifier: GPL-3.0-or-later
"""Export Rigged glTF: the chosen splats, their armature and its animation as one .glb."""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy
from bpy_extras.io_utils import ExportHelper

from ..core.errors import GSkinError
from ..scene.bone_frames import armature_of
from ..scene.gltf_export import export_glb
from ..session.chosen import chosen_splats


class GSKIN_OT_export_glb(bpy.types.Operator, ExportHelper):
    """Export the splats with armature, weights and animation as a .glb with KHR_gaussian_splatting"""

    bl_idname = "gskin.export_glb"
    bl_label = "Export Rigged glTF (.glb)"
    bl_options = {"PRESET"}

    filename_ext = ".glb"
    if TYPE_CHECKING:
        filepath: str  # ExportHelper's
    filter_glob: bpy.props.StringProperty(default="*.glb", options={"HIDDEN"})
    animations: bpy.props.BoolProperty(
        name="Animations", description="Export the armature's actions, too", default=True
    )
    deform_bones_only: bpy.props.BoolProperty(
        name="Deform Bones Only", description="Leave out bones that move no splats, such as controls", default=False
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        problem = ""
        if splats is None:
            problem = "Select a splat object"
        elif armature_of(splats) is None:
            problem = "The splats follow no armature directly, as a rigged glTF needs: run Auto-Skin or bind them"
        elif context.mode not in {"OBJECT", "POSE"} or splats.mode == "EDIT":
            problem = "Go to Object Mode"
        elif "io_scene_gltf2" not in context.preferences.addons:
            problem = "Turn on the add-on glTF 2.0 in the preferences"
        if problem:
            cls.poll_message_set(problem)
        return not problem

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        try:
            lost = export_glb(
                self.filepath, [splats], deform_bones_only=self.deform_bones_only, animations=self.animations
            )
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        self.report({"INFO"}, f"'{splats.name}' and '{armature_of(splats).name}' were exported")
        for sentence in lost:
            self.report({"WARNING"}, sentence)
        return {"FINISHED"}


CLASSES = (GSKIN_OT_export_glb,)
