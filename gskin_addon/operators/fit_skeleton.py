# SPDX-License-Identifier: GPL-3.0-or-later
"""Fit Human, Fit Quadruped, Fit Bird: an armature fitted to the chosen splats."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.errors import GSkinError
from ..core.skeleton.fit import fit
from ..scene.fitted_rig import create_fitted_rig, rigify_is_on, turn_rigify_on
from ..scene.landmarks import read_landmarks
from ..scene.splat_object import read_cloud, splat_count
from ..session.chosen import chosen_splats, panel_settings


class _Fit:
    bl_options = {"REGISTER", "UNDO"}

    kind = ""

    front: bpy.props.EnumProperty(
        name="Looks to",
        description="To where the body looks, along the world's axes",
        items=(
            ("auto", "Find Out", "Compare the four sides"),
            ("-y", "-Y", "To the front view, as Blender's figures do"),
            ("+x", "+X", "To the right view"),
            ("+y", "+Y", "To the back view"),
            ("-x", "-X", "To the left view"),
        ),
    )
    sides: bpy.props.EnumProperty(
        name="Sides",
        description="Whether the left side is the mirror image of the right one",
        items=(
            ("auto", "Where They Are", "Mirror images where both sides nearly are"),
            ("alike", "Alike", "Mirror images always"),
            ("apart", "Apart", "Each side as it is, for a pose"),
        ),
    )
    rigify: bpy.props.BoolProperty(
        name="Rigify Metarig",
        description="Make one of Rigify's metarigs, for which Rigify makes controls (this turns Rigify on, which comes "
        "with Blender); else an armature of the same bones",
        default=True,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        problem = ""
        if splats is None or splat_count(splats) < 2:
            problem = "Choose a splat object"
        elif splats.mode == "EDIT":
            problem = "Leave Edit Mode (Tab)"
        if problem:
            cls.poll_message_set(problem)  # type: ignore[attr-defined]
        return not problem

    def execute(self: Any, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        try:
            found = fit(
                self.kind,
                read_cloud(splats),
                front=self.front,
                alike={"alike": True, "apart": False}.get(self.sides),
                landmarks=read_landmarks(splats),
            )
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        if self.rigify:
            turn_rigify_on()
        armature = create_fitted_rig(found, f"{splats.name} Skeleton")
        for obj in context.selected_objects:
            obj.select_set(False)
        for obj in (splats, armature):
            if obj.name in context.view_layer.objects:  # in an excluded collection nothing can be selected
                obj.select_set(True)
        context.view_layer.objects.active = armature
        settings = panel_settings(context)
        if settings.armature is not None:
            settings.armature = armature
        kind = "metarig" if rigify_is_on() else "armature"
        if not found.front_sure:
            self.report(
                {"WARNING"}, f"'{armature.name}' may look the wrong way; set Looks to if left and right are swapped"
            )
        elif found.unsure:
            self.report(
                {"WARNING"},
                f"'{armature.name}' may be off: check it from the front and the side, mark hands, feet and head, and "
                "fit again",
            )
        else:
            self.report({"INFO"}, f"'{armature.name}': a {kind} of {int(found.deform.sum())} bones; look at its joints")
        return {"FINISHED"}


class GSKIN_OT_fit_human(_Fit, bpy.types.Operator):
    """Fit the skeleton of a person to the splats: a Rigify metarig whose joints lie in the body, with both sides alike
    where the body's are"""

    bl_idname = "gskin.fit_human"
    bl_label = "Fit Human"

    kind = "human"


class GSKIN_OT_fit_quadruped(_Fit, bpy.types.Operator):
    """Fit the skeleton of a four-legged animal to the splats: a Rigify metarig whose joints lie in the body"""

    bl_idname = "gskin.fit_quadruped"
    bl_label = "Fit Quadruped"

    kind = "quadruped"


class GSKIN_OT_fit_bird(_Fit, bpy.types.Operator):
    """Fit the skeleton of a bird to the splats, by its outline alone: a Rigify metarig to begin with, which wants
    correcting"""

    bl_idname = "gskin.fit_bird"
    bl_label = "Fit Bird"

    kind = "bird"


CLASSES = (GSKIN_OT_fit_human, GSKIN_OT_fit_quadruped, GSKIN_OT_fit_bird)
