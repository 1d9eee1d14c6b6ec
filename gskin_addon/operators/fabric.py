# SPDX-License-Identifier: GPL-3.0-or-later
"""Make Paintable: the fabric under splats, on which Blender's weight tools work; and its removal."""

from __future__ import annotations

import bpy

from ..core.errors import GSkinError
from ..scene.cleanup import begin_selecting
from ..scene.fabric import has_fabric, iter_make_fabric, strip_fabric
from ..scene.splat_object import is_splat_object
from ..scene.steps import Steps
from ..session.chosen import chosen_splats
from ._sliced import SlicedClick


class GSKIN_OT_make_paintable(SlicedClick, bpy.types.Operator):
    """Lay a fabric under the splats, so that Blender's brushes and weight tools work on them. It is seen in Weight
    Paint and Edit Mode only, and never rendered or exported. Auto-Skin does this by itself"""

    bl_idname = "gskin.make_paintable"
    bl_label = "Make Splats Paintable"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if chosen_splats(context) is None:
            cls.poll_message_set("Select splats")
            return False
        return True

    def work(self, context: bpy.types.Context) -> Steps[str]:
        splats = chosen_splats(context)
        mode = splats.mode
        begin_selecting(context, splats)
        try:
            count = yield from iter_make_fabric(splats)
        finally:
            if splats.mode != mode:
                bpy.ops.object.mode_set(mode=mode)
        return f"{count:,} triangles join the splats of '{splats.name}' for painting and selecting"


class GSKIN_OT_remove_fabric(bpy.types.Operator):
    """Take the fabric under the splats away again; splats and weights stay"""

    bl_idname = "gskin.remove_fabric"
    bl_label = "Remove Fabric"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or not is_splat_object(splats) or not has_fabric(splats):
            cls.poll_message_set("The splats have no fabric")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        try:
            begin_selecting(context, splats)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        strip_fabric(splats.data)
        return {"FINISHED"}


CLASSES = (GSKIN_OT_make_paintable, GSKIN_OT_remove_fabric)
