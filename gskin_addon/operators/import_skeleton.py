# SPDX-License-Identifier: GPL-3.0-or-later
"""Import Skeleton: joints of rigging programs, motion files and characters, brought into the chosen splats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy_extras.io_utils import ImportHelper

from ..core.skeleton.placing import Placing
from ..scene.import_skeleton import SUFFIXES, iter_import_skeleton
from ..scene.object_ref import ObjectRef
from ..scene.steps import Steps
from ..session.chosen import chosen_splats, panel_settings
from ._sliced import Sliced


class GSKIN_OT_import_skeleton(Sliced, bpy.types.Operator, ImportHelper):
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

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.asked = True
        answer: set[str] = set(super().invoke(context, event))
        return answer

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.begin(context)

    def work(self, context: bpy.types.Context) -> Steps[str]:
        """Read, look for the place, add; then splats and armature are selected."""
        splats = chosen_splats(context)
        ref = None if splats is None else ObjectRef(splats)
        armature, placing = yield from iter_import_skeleton(Path(self.filepath), splats if self.guess else None)
        splats = None if ref is None else ref.find()
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
        if placing is None or splats is None:
            return words
        if placing.plain:
            words += f", {placing.plain}"
        doubt = _doubt(placing, splats.name)
        if not doubt:
            return words
        self.report({"WARNING"}, f"{words}; {doubt}")
        return ""


def _doubt(placing: Placing, splats: str) -> str:
    """What is to be checked; empty for nothing."""
    if placing.unsure:
        return f"it does not lie well in '{splats}': check size, axes and place"
    if placing.either_way:
        return "it would fit as well turned about: check that its front is the body's"
    return ""


CLASSES = (GSKIN_OT_import_skeleton,)
