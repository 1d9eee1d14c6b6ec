# SPDX-License-Identifier: GPL-3.0-or-later
"""Where splats stand after their import, which way is up, and how Solid mode shows them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import bpy

from ..core.errors import GSkinError
from ..scene import views
from ..scene.placement import bring_rig, is_placed, place_on_floor, shift_of, turn_up, undo_placement, up_of
from ..session.chosen import chosen_armature, chosen_splats

# A mix-in at run time: Blender would register a base class that is an operator itself.
_Operator = bpy.types.Operator if TYPE_CHECKING else object


class _OnSplats(_Operator):
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if chosen_splats(context) is None:
            cls.poll_message_set("No splats are chosen")
            return False
        if context.mode != "OBJECT":
            cls.poll_message_set("Go to Object Mode")
            return False
        return True

    def _try(self, work: Callable[..., None], *arguments: object) -> set[str]:
        try:
            work(*arguments)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        return {"FINISHED"}


class GSKIN_OT_turn_up(_OnSplats, bpy.types.Operator):
    """Let another axis of the file point up; rotations and spherical harmonics of the splats turn, too"""

    bl_idname = "gskin.turn_up"
    bl_label = "Turn Up"

    up: bpy.props.EnumProperty(
        name="Up",
        description="The file's axis that points up in Blender",
        items=[
            ("z", "Z", "As Blender; the file's axes are kept"),
            ("y", "Y", "As glTF and many viewers"),
            ("-y", "-Y", "As COLMAP, and so most training programs"),
        ],
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self.properties.is_property_set("up"):
            self.up = up_of(chosen_splats(context))
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self._try(turn_up, chosen_splats(context), self.up)


class GSKIN_OT_place_on_floor(_OnSplats, bpy.types.Operator):
    """Stand the splats on the floor at the world's origin"""

    bl_idname = "gskin.place_on_floor"
    bl_label = "Place on Floor"

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self._try(place_on_floor, chosen_splats(context))


class _OnPlacedSplats(_OnSplats):
    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if not is_placed(chosen_splats(context)):
            cls.poll_message_set("The splats are where their file has them")
            return False
        return True


class GSKIN_OT_undo_placement(_OnPlacedSplats, bpy.types.Operator):
    """Move the splats back to where their file has them, as a rig made for the file needs them"""

    bl_idname = "gskin.undo_placement"
    bl_label = "Undo Placement"

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self._try(undo_placement, chosen_splats(context))


class GSKIN_OT_move_rig_to_splats(_OnSplats, bpy.types.Operator):
    """Move an armature that was made for the file's coordinates by as much as the splats were moved at import"""

    bl_idname = "gskin.move_rig_to_splats"
    bl_label = "Move Rig to Splats"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if not shift_of(chosen_splats(context)).any():
            cls.poll_message_set("The splats are where their file has them")
            return False
        if chosen_armature(context) is None:
            cls.poll_message_set("No armature is chosen")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        bring_rig(chosen_armature(context), shift_of(chosen_splats(context)))
        return {"FINISHED"}


class GSKIN_OT_show_splat_colors(bpy.types.Operator):
    """Show colours as captured in Solid mode, or again the look that the 3D views had; all objects change with it"""

    bl_idname = "gskin.show_splat_colors"
    bl_label = "Show Splat Colors"
    bl_options = {"REGISTER"}

    show: bpy.props.BoolProperty(name="Show", default=True)

    def execute(self, context: bpy.types.Context) -> set[str]:
        if self.show:
            views.show_colors(context.screen)
        else:
            views.hide_colors(context.screen)
        return {"FINISHED"}


CLASSES = (
    GSKIN_OT_turn_up,
    GSKIN_OT_place_on_floor,
    GSKIN_OT_undo_placement,
    GSKIN_OT_move_rig_to_splats,
    GSKIN_OT_show_splat_colors,
)
