# SPDX-License-Identifier: GPL-3.0-or-later
"""Import Skeleton: joints of rigging programs, motion files and characters, brought into the chosen splats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy_extras.io_utils import ImportHelper

from ..core.errors import GSkinError
from ..scene.import_skeleton import SUFFIXES, import_skeleton
from ..session.chosen import chosen_splats, panel_settings


class GSKIN_OT_import_skeleton(bpy.types.Operator, ImportHelper):
    """Import a skeleton for the splats: joints as RigNet, UniRig, Puppeteer and SkinTokens write them (.txt, .npz), a
    motion file (.bvh), or the armature of a character (.fbx, .vrm, .glb, .blend). Its axes and its unit are guessed
    from where the splats are"""

    bl_idname = "gskin.import_skeleton"
    bl_label = "Import Skeleton"
    bl_options = {"REGISTER", "UNDO"}

    if TYPE_CHECKING:
        filepath: str  # ImportHelper's
    filter_glob: bpy.props.StringProperty(default=";".join(f"*{suffix}" for suffix in SUFFIXES), options={"HIDDEN"})
    guess: bpy.props.BoolProperty(
        name="Bring Into Splats",
        description="Turn, scale and move the skeleton so that it lies in the splats; off: as the file has it, z up",
        default=True,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set("Go to Object Mode (Tab)")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        try:
            armature, placing = import_skeleton(Path(self.filepath), splats if self.guess else None)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        for obj in context.selected_objects:
            obj.select_set(False)
        for obj in (splats, armature):
            if obj is not None and obj.name in context.view_layer.objects:
                obj.select_set(True)
        context.view_layer.objects.active = armature
        settings = panel_settings(context)
        if settings.armature is not None:
            settings.armature = armature
        words = f"'{armature.name}': {len(armature.data.bones)} bones"
        if placing is not None and placing.plain:
            words += f", {placing.plain}"
        if placing is not None and placing.unsure:
            self.report({"WARNING"}, f"{words}; it does not lie well in '{splats.name}': check size, axes and place")
        elif placing is not None and placing.either_way:
            self.report({"WARNING"}, f"{words}; it would fit as well turned about: check that its front is the body's")
        else:
            self.report({"INFO"}, words)
        return {"FINISHED"}


CLASSES = (GSKIN_OT_import_skeleton,)
