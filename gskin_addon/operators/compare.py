# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare Weights: the splats by the weights from before learning, and by the result again."""

from __future__ import annotations

import bpy

from ..core.errors import GSkinError
from ..scene.bone_frames import armature_of
from ..scene.compared import Side, compared, show_side
from ..scene.single_user import said_of, sharers
from ..session.chosen import chosen_splats


class GSKIN_OT_compare_weights(bpy.types.Operator):
    """Switch between the weights that learning started from and its result. Each side keeps what you paint on it"""

    bl_idname = "gskin.compare_weights"
    bl_label = "Compare Weights"
    bl_options = {"REGISTER", "UNDO"}

    show: bpy.props.EnumProperty(
        name="Show",
        description="Which weights the splats follow",
        items=[
            ("OTHER", "The Other", "Those that are not shown now"),
            ("BEFORE", "Before", "What learning started from"),
            ("RESULT", "Result", "What was learned, with your own edits"),
        ],
    )

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        splats = chosen_splats(context)
        now = None if splats is None else compared(splats)
        if now is None or properties.show == "OTHER":
            return cls.__doc__
        if properties.show == "BEFORE":
            return f"Pose the splats by what learning started from: {now[0]}. The result is kept as it is"
        return "Pose the splats by the learned weights, with your own edits"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        problem = ""
        if splats is None or compared(splats) is None or armature_of(splats) is None:
            problem = "Select splats that Auto-Skin gave learned weights"
        elif splats.mode == "EDIT":
            problem = "Leave Edit Mode (Tab)"
        if problem:
            cls.poll_message_set(problem)
        return not problem

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        name, shown = compared(splats)
        side: Side = "before" if shown == "result" else "result"
        if self.show != "OTHER":
            side = "before" if self.show == "BEFORE" else "result"
        others = sharers(splats)
        try:
            show_side(splats, side)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        words = f"'{splats.name}' follows " + (name if side == "before" else "the learned weights")
        alone = others if len(sharers(splats)) < len(others) else []
        self.report({"INFO"}, "; ".join(filter(None, (words, said_of(splats, alone)))))
        return {"FINISHED"}


CLASSES = (GSKIN_OT_compare_weights,)
