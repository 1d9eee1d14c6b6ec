# SPDX-License-Identifier: GPL-3.0-or-later
"""What all operators share that select splats: how a selection meets the one before, and the mode it is shown in."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..scene.cleanup import out_of_edit_mode
from ..scene.selecting import active_splat, enter_edit_mode, hidden_now, mark_selected, selected_now
from ..scene.stand_in import readable
from ..scene.steps import Steps, part_of
from ..session.chosen import chosen_splats
from ._sliced import SlicedClick

Mask = NDArray[np.bool_]

WAYS = [
    ("SET", "Set", "Select these, and nothing else"),
    ("ADD", "Extend", "Select these as well"),
    ("SUB", "Subtract", "Select these no more"),
    ("AND", "Intersect", "Of what is selected, keep these"),
]


class SelectSplats(SlicedClick):
    """Mixin of an operator: `find` says which splats, here they are selected. In Weight Paint with its vertex
    selection, else in Edit Mode, which is not left where it is open."""

    bl_options = {"REGISTER", "UNDO"}

    mode: bpy.props.EnumProperty(name="Mode", description="What becomes of what is selected", items=WAYS)

    active: int | None = None
    """The splat that was clicked last in Edit Mode, while `find` runs."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if chosen_splats(context) is None:
            cls.poll_message_set("Select splats")  # type: ignore[attr-defined]
            return False
        return True

    def find(self, context: bpy.types.Context, splats: bpy.types.Object, selected: Mask) -> Steps[Mask]:
        """(N,) the splats that are meant, in slices. selected (N,): now. In Edit Mode `splats` is a copy
        (`stand_in.py`). Raises InputError for options that cannot be used."""
        raise NotImplementedError

    def words(self) -> str:
        """What is to be said besides the number of splats that are selected."""
        return ""

    def work(self, context: bpy.types.Context) -> Steps[str]:
        splats = chosen_splats(context)
        mode = splats.mode
        self.active = active_splat(splats)
        with at_hand(context, splats) as there:
            yield 0.0
            before = selected_now(there)
            found = yield from part_of(self.find(context, there, before), 0.0, 1.0)
            after = combined(self.mode, before, found) & ~hidden_now(there)
            yield 1.0
        if mode == "WEIGHT_PAINT":
            splats.data.use_paint_mask_vertex = True
            mark_selected(splats, after)
        else:
            enter_edit_mode(context, splats, after)
        said = f"{after.sum():,} of {len(after):,} splats selected"
        return "; ".join(filter(None, (said, self.words())))


def at_hand(context: bpy.types.Context, splats: bpy.types.Object) -> AbstractContextManager[bpy.types.Object]:
    """A block in which the splats can be read: as they are, or where they are edited a copy (`stand_in.py`)."""
    if splats.mode == "WEIGHT_PAINT":
        return nullcontext(splats)
    if splats.mode == "EDIT":
        context.view_layer.objects.active = splats
        return readable(splats)
    return out_of_edit_mode(context, splats)


def combined(way: str, before: Mask, found: Mask) -> Mask:
    """(N,) what is selected after `found` met what was selected `before`, by one of `WAYS`."""
    made: dict[str, Any] = {"SET": found, "ADD": before | found, "SUB": before & ~found, "AND": before & found}
    return np.asarray(made[way], np.bool_)
