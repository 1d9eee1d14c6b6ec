# SPDX-License-Identifier: GPL-3.0-or-later
"""Select Bad Splats, Clean Splats: what deforms badly is shown, put aside, removed or reshaped."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import bpy

from ..core.errors import GSkinError, InputError
from ..scene.cleanup import (
    begin_selecting,
    find_bad_splats,
    put_aside,
    remove_splats,
    reshape_splats,
    show_selected,
)
from ..scene.splat_object import splat_count
from ..session.chosen import chosen_splats


class _Finder:
    bl_options = {"REGISTER", "UNDO"}
    if TYPE_CHECKING:
        poll_message_set: Any  # every operator has it

    strays: bpy.props.BoolProperty(
        name="Strays", description="Single splats and small clusters that lie off the body", default=True
    )
    faint_giants: bpy.props.BoolProperty(
        name="Faint Giants", description="Nearly transparent splats that cover a large part of the body", default=True
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if chosen_splats(context) is None:
            cls.poll_message_set("Select a splat object; import one with File > Import > Gaussian Splats")
            return False
        return True


class GSKIN_OT_select_bad_splats(_Finder, bpy.types.Operator):
    """Select the splats that would deform badly, and show them in Edit Mode"""

    bl_idname = "gskin.select_bad_splats"
    bl_label = "Select Bad Splats"

    needle_ratio: bpy.props.FloatProperty(
        name="Needles From",
        description="Also select splats longer than this times their width; 0 for none",
        default=0.0,
        min=0.0,
        soft_max=50.0,
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        obj = chosen_splats(context)
        try:
            begin_selecting(context, obj)
            bad, counts = find_bad_splats(
                obj, strays=self.strays, faint_giants=self.faint_giants, needle_ratio=self.needle_ratio
            )
            show_selected(context, obj, bad)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        self.report({"INFO"}, _sentence(counts, splat_count(obj), "selected"))
        return {"FINISHED"}


class GSKIN_OT_clean_splats(_Finder, bpy.types.Operator):
    """Take the splats that would deform badly out of the object, and widen needles"""

    bl_idname = "gskin.clean_splats"
    bl_label = "Clean Splats"

    action: bpy.props.EnumProperty(
        name="Action",
        description="What to do with strays and faint giants",
        items=[
            ("ASIDE", "Put Aside", "Move them to a hidden object of their own; Join brings them back"),
            ("REMOVE", "Remove", "Delete them"),
        ],
        default="ASIDE",
    )
    max_aspect: bpy.props.FloatProperty(
        name="Max Aspect",
        description="Shorten and widen splats longer than this times their width, keeping their area; 0 for none",
        default=0.0,
        min=0.0,
        soft_max=50.0,
    )
    balls: bpy.props.BoolProperty(
        name="Isotropic", description="Make every splat a ball that covers the same area", default=False
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if chosen_splats(context).mode == "EDIT":
            cls.poll_message_set("Leave Edit Mode (Tab)")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        obj = chosen_splats(context)
        total = splat_count(obj)
        if 0 < self.max_aspect < 1:
            self.report({"ERROR"}, f"Max Aspect is {self.max_aspect:g}; it must be 0 or at least 1.")
            return {"CANCELLED"}
        try:
            bad, counts = find_bad_splats(obj, strays=self.strays, faint_giants=self.faint_giants)
            if bad.all():
                raise InputError(
                    f"All {total:,} splats of '{obj.name}' are strays or faint giants, so nothing was changed: "
                    "no splat would be left; switch off Strays or Faint Giants."
                )
            if bad.any():
                if self.action == "ASIDE":
                    put_aside(obj, bad)
                else:
                    remove_splats(obj, bad)
            needles = reshape_splats(obj, max_aspect=self.max_aspect, balls=self.balls)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        words = _sentence(counts, total, "put aside" if self.action == "ASIDE" else "removed")
        if self.max_aspect:
            words += f"; {needles:,} needles widened"
        if self.balls:
            words += f"; {splat_count(obj):,} splats made balls"
        self.report({"INFO"}, words)
        return {"FINISHED"}


def _sentence(counts: dict[str, int], total: int, done: str) -> str:
    parts = " and ".join(f"{number:,} {name}" for name, number in counts.items()) or "Nothing"
    return f"{parts} of {total:,} splats {done}"


CLASSES = (GSKIN_OT_select_bad_splats, GSKIN_OT_clean_splats)
