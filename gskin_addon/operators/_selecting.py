# SPDX-License-Identifier: GPL-3.0-or-later
"""What all operators share that select splats: how a selection meets the one before, and the mode it is shown in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import GSkinError
from ..scene.cleanup import begin_selecting
from ..scene.selecting import active_splat, enter_edit_mode, hidden_now, mark_selected, selected_now
from ..session.chosen import chosen_splats

Mask = NDArray[np.bool_]

WAYS = [
    ("SET", "Set", "Select these, and nothing else"),
    ("ADD", "Extend", "Select these as well"),
    ("SUB", "Subtract", "Select these no more"),
    ("AND", "Intersect", "Of what is selected, keep these"),
]


class SelectSplats:
    """Mixin of an operator: `find` says which splats, here they are selected. In Weight Paint with its vertex
    selection, else in Edit Mode."""

    bl_options = {"REGISTER", "UNDO"}

    mode: bpy.props.EnumProperty(name="Mode", description="What becomes of what is selected", items=WAYS)

    report: Callable[[set[str], str], None]

    active: int | None = None
    """The splat that was clicked last in Edit Mode, while `find` runs."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if chosen_splats(context) is None:
            cls.poll_message_set("Select splats")  # type: ignore[attr-defined]
            return False
        return True

    def find(self, context: bpy.types.Context, splats: bpy.types.Object, selected: Mask) -> Mask:
        """(N,) the splats that are meant. selected (N,): now. Raises InputError for options that cannot be used."""
        raise NotImplementedError

    def words(self) -> str:
        """What is to be said besides the number of splats that are selected."""
        return ""

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        mode = splats.mode
        try:
            self.active = active_splat(splats)
            if mode == "WEIGHT_PAINT":
                splats.data.use_paint_mask_vertex = True
            else:
                begin_selecting(context, splats)
            before = selected_now(splats)
            after = combined(self.mode, before, self.find(context, splats, before)) & ~hidden_now(splats)
        except GSkinError as error:
            if splats.mode != mode:
                bpy.ops.object.mode_set(mode=mode)
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        if mode == "WEIGHT_PAINT":
            mark_selected(splats, after)
        else:
            enter_edit_mode(context, splats, after)
        said = f"{after.sum():,} of {len(after):,} splats selected"
        self.report({"INFO"}, "; ".join(filter(None, (said, self.words()))))
        return {"FINISHED"}


def combined(way: str, before: Mask, found: Mask) -> Mask:
    """(N,) what is selected after `found` met what was selected `before`, by one of `WAYS`."""
    made: dict[str, Any] = {"SET": found, "ADD": before | found, "SUB": before & ~found, "AND": before & found}
    return np.asarray(made[way], np.bool_)
