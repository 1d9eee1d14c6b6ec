# SPDX-License-Identifier: GPL-3.0-or-later
"""What all operators share that change weights which are there already."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.skinning.edits.body_graph import BodyGraph, body_graph
from ..scene.bone_frames import armature_of
from ..scene.seams import read_seams
from ..scene.splat_object import read_cloud
from ..scene.steps import Steps
from ..scene.weight_edits import Change, iter_edit_weights, selected_splats, shows_selection
from ..session.chosen import chosen_splats
from ._sliced import Sliced

Array = NDArray[Any]


class WeightEdit(Sliced):
    """Mixin of an operator: `changes` makes what works on the weights, here it is run."""

    needs_selection = False
    """Whether it is for selected splats alone; else, where no selection is shown, for all."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or armature_of(splats) is None:
            cls.poll_message_set("Select splats that follow an armature")  # type: ignore[attr-defined]
            return False
        return True

    def changes(self, splats: bpy.types.Object, selected: Array | None) -> Change:
        """The function from weights to weights. Reads Blender now, so that the function need not.

        Raises InputError: options that cannot be used.
        """
        raise NotImplementedError

    def words(self) -> str:
        """What is to be said besides the number of splats that changed."""
        return ""

    def begin(self, context: bpy.types.Context, splats: bpy.types.Object) -> Steps[int]:
        chosen = shows_selection(splats) or self.needs_selection
        selected = selected_splats(splats) if chosen else None
        if selected is not None and not selected.any():
            raise InputError(f"No splats of '{splats.name}' are selected; select some in Edit Mode (Tab).")
        self.leave_edit_mode(context, splats)
        return iter_edit_weights(splats, self.changes(splats, selected), self.reached(splats, selected))

    def reached(self, splats: bpy.types.Object, selected: Array | None) -> Array | None:
        """Splats (N,) bool that may change; None for all. `changes` may still mark some of its array while it runs."""
        return selected

    def finish(self, context: bpy.types.Context, count: int) -> str:
        return "; ".join(filter(None, (f"Weights of {count:,} splats changed", self.words())))


def graph_of(splats: bpy.types.Object) -> Callable[[], BodyGraph]:
    """A function that makes the graph of the body, in world space; reads Blender now."""
    means, sides = read_cloud(splats).means, read_seams(splats)
    return lambda: body_graph(means, walls=sides)


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

