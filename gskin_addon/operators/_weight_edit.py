# SPDX-License-Identifier: GPL-3.0-or-later
"""What all operators share that change weights which are there already."""

from __future__ import annotations

from typing import Any

import bpy
from numpy.typing import NDArray

from ..core.errors import InputError
from ..scene.bone_frames import armature_of
from ..scene.single_user import said_of, sharers
from ..scene.stand_in import readable
from ..scene.steps import Steps
from ..scene.weight_edits import Change, iter_edit_weights, selected_splats, shows_selection
from ..session.chosen import chosen_splats
from ._sliced import SlicedClick

Array = NDArray[Any]


class WeightEdit(SlicedClick):
    """Mixin of an operator: `changes` makes what works on the weights, here it is run, in slices where there is a
    window, in the mode that the artist is in.

    Edit Mode is not left, which Blender needs long for, unless the operator needs that.
    """

    bl_options = {"REGISTER", "UNDO"}
    cancelled = "Cancelled; no weights were changed"
    needs_selection = False
    """Whether it is for selected splats alone; else, where no selection is shown, for all."""

    leaves_edit_mode = False
    """Whether it changes more than weights."""

    _mode = ""
    _sharers: list[str] = []
    """Objects that have the same mesh and weights as the splats, before these change."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or armature_of(splats) is None:
            cls.poll_message_set("Select splats that follow an armature")  # type: ignore[attr-defined]
            return False
        return True

    def changes(self, splats: bpy.types.Object, selected: Array | None) -> Change:
        """The function from weights to weights. Reads Blender now, so that the function need not. In Edit Mode
        `splats` is a copy (`stand_in.py`).

        Raises InputError: options that cannot be used.
        """
        raise NotImplementedError

    def done(self, count: int) -> str:
        """What is said of the number of changed splats."""
        return f"Weights of {count:,} splats changed"

    def words(self) -> str:
        """What is to be said besides the number of splats that changed."""
        return ""

    def work(self, context: bpy.types.Context) -> Steps[int]:
        splats = chosen_splats(context)
        self._sharers = sharers(splats)
        chosen = shows_selection(splats) or self.needs_selection
        if splats.mode == "EDIT" and (self.leaves_edit_mode or self._sharers):
            self._mode = splats.mode
            context.view_layer.objects.active = splats
            bpy.ops.object.mode_set(mode="OBJECT")
        with readable(splats) as there:
            selected = selected_splats(there) if chosen else None
            if selected is not None and not selected.any():
                raise InputError(f"No splats of '{there.name}' are selected; select some in Edit Mode (Tab).")
            yield 0.0
            return (yield from self.steps(context, splats, there, selected))

    def steps(
        self, context: bpy.types.Context, splats: bpy.types.Object, there: bpy.types.Object, selected: Array | None
    ) -> Steps[int]:
        """The work in slices, of which only the last changes the scene; gives the number of splats changed. `there`:
        the splats, in Edit Mode their copy."""
        return iter_edit_weights(splats, self.changes(there, selected), self.reached(there, selected), there=there)

    def reached(self, splats: bpy.types.Object, selected: Array | None) -> Array | None:
        """Splats (N,) bool that may change; None for all. `changes` may still mark some of them while it runs."""
        return selected

    def _said(self, context: bpy.types.Context, count: int) -> set[str]:
        splats = chosen_splats(context)
        shared = said_of(splats, self._sharers) if count and splats is not None else ""
        return super()._said(context, "; ".join(filter(None, (self.done(count), self.words(), shared))))

    def _leave(self, context: bpy.types.Context) -> None:
        super()._leave(context)
        splats = chosen_splats(context)
        if splats is not None:
            self._restore(splats)

    def _restore(self, splats: bpy.types.Object) -> None:
        if self._mode == "EDIT" and splats.mode == "OBJECT":
            bpy.ops.object.mode_set(mode="EDIT")
        self._mode = ""


def bone_column(splats: bpy.types.Object, name: str, bones: list[str]) -> int:
    """The column of the bone `name`, or without a name of the active vertex group's. Raises InputError."""
    active = splats.vertex_groups.active
    wanted = name or (active.name if active is not None else "")
    if wanted not in bones:
        raise InputError(
            f"'{wanted}' is no deform bone of the armature; choose a bone." if wanted else "Choose a bone."
        )
    return bones.index(wanted)


def search_bones(operator: Any, context: bpy.types.Context, text: str) -> list[str]:
    """Deform bones of the armature whose names hold `text`."""
    armature = armature_of(chosen_splats(context))
    return [bone.name for bone in armature.data.bones if bone.use_deform and text.lower() in bone.name.lower()]

