# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes of a splat object's weights in its vertex groups: of the selection, with locked groups kept to the bit."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import nullcontext
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.skinning.edits.assign import normalise
from ..core.skinning.edits.keep import keep
from . import names
from .armature import deform_bone_names
from .attributes import read_flags
from .binding import bind, check_splats
from .bone_frames import armature_of, bone_order
from .compared import mark_edited
from .edited_weights import EditedRef, iter_write_edited
from .influences import strongest, write_influences
from .object_ref import ObjectRef
from .probes import follow_stack
from .rotation_nodes import frames_of
from .stand_in import readable
from .steps import Steps, in_thread, part_of
from .vertex_groups import GroupsAside, group_state, restore_group_state
from .weights import iter_read_weights

Array = NDArray[Any]

Change = Callable[[Array], Array]
"""Weights (N, B) of the armature's deform bones to new ones, rows of zeros to what they shall be; runs in a thread,
without Blender."""


def iter_edit_weights(
    obj: bpy.types.Object,
    change: Change,
    selected: Array | None = None,
    *,
    lock: Collection[str] = (),
    even: bool = False,
    there: bpy.types.Object | None = None,
) -> Steps[int]:
    """Let `change` work on the weights of `obj`; the number of splats whose weights are others now.

    selected (N,) bool: only these change, all where left out. Groups that are locked, by the artist or by their name
    in `lock`, keep their weights to the bit, as do those of no bone; changed rows sum to 1 and keep the strongest
    `names.INFLUENCES` bones, which is what turns splats. `change` gets rows that sum to 1, or to 0 for splats without
    any weight; those that it gives back as they were stay to the bit, unless `even`: then they are brought to a sum of
    1, too. there: what to read them from in Edit Mode, see `readable`, where there is such a copy already.

    In slices; only the last one changes the scene. In Edit Mode, which goes on, the last ones do, and what they did is
    taken back where they are given up.

    Raises InputError: the object follows no armature, or was changed meanwhile; all bones locked.
    """
    armature = armature_of(obj)
    if armature is None:
        raise InputError(f"'{obj.name}' follows no armature by weights of its own; bind it to one first.")
    bones = deform_bone_names(armature)
    locked = np.array([name in lock or _is_locked(obj, name) for name in bones])
    if locked.all():
        raise InputError(f"All vertex groups of '{obj.name}' are locked; unlock those that may change.")
    ref = EditedRef(obj) if obj.mode == "EDIT" else ObjectRef(obj)
    with readable(obj) if there is None else nullcontext(there) as source:
        check_splats(source)
        painted, _ = yield from part_of(iter_read_weights(source, bones), 0.0, 0.3)

    def work() -> tuple[Array, Array, Array]:
        before = normalise(painted)
        after = change(before.copy())
        touched = np.ones(len(before), np.bool_) if even else (after != before).any(axis=1)
        if selected is not None:  # known only now, where the change itself says which it reaches
            touched &= selected
        after = keep(painted, after, selected=touched, locked=locked, most=names.INFLUENCES)
        index, value = strongest(after, min(names.INFLUENCES, len(bones)))
        return after, index, np.where((after > 0).any(axis=1)[:, None], value, 0)

    after, index, value = yield from part_of(in_thread(work), 0.3, 0.6)
    moved = after != painted
    count = int(moved.any(axis=1).sum())
    if not count:
        return 0
    if isinstance(ref, EditedRef):
        yield 0.6
        yield from part_of(iter_write_edited(ref, bones, painted, after), 0.6, 1.0)
        return count
    obj = ref.find()
    # A group that is made again comes last: those behind the first changed one, too, so that their order stays.
    place = {group.name: group.index for group in obj.vertex_groups}
    changed = {bones[i] for i in np.flatnonzero(moved.any(axis=0))}
    first = min(place.get(name, len(place)) for name in changed)
    again = [name for name in place if place[name] >= first and name in bones and not locked[bones.index(name)]]
    again += [name for name in bones if name in changed and name not in place]
    state = group_state(obj)
    column = {name: bones.index(name) for name in again}
    with GroupsAside(obj) as groups:
        yield from part_of(groups.write(again, lambda i: np.ascontiguousarray(after[:, column[again[i]]])), 0.6, 0.95)
        obj = groups.check()
        frames = frames_of(obj) or bind(obj, armature)
        obj = groups.commit()
    restore_group_state(obj, state)
    write_influences(obj, bone_order(frames), bones, index, value)
    follow_stack(obj)
    mark_edited(obj, True)
    return count


def locked_groups(obj: bpy.types.Object, bones: Collection[str]) -> list[str]:
    """The bones whose vertex groups the artist has locked."""
    return [name for name in bones if _is_locked(obj, name)]


def _is_locked(obj: bpy.types.Object, group: str) -> bool:
    return group in obj.vertex_groups and obj.vertex_groups[group].lock_weight


def selected_splats(obj: bpy.types.Object) -> Array:
    """(N,) bool: the splats that are selected, as Edit Mode shows them, also while it is open; in Weight Paint with
    face selection those of the selected faces."""
    if obj.mode == "EDIT":
        obj.update_from_editmode()
    if obj.mode == "WEIGHT_PAINT" and obj.data.use_paint_mask:
        selected = np.zeros(len(obj.data.vertices), np.bool_)
        selected[_corners_of_selected_faces(obj)] = True
        return selected
    return read_flags(obj.data, "select")


def shows_selection(obj: bpy.types.Object) -> bool:
    """Whether an artist sees what is selected: in Edit Mode, or in Weight Paint with vertex or face selection."""
    masked = obj.data.use_paint_mask_vertex or obj.data.use_paint_mask
    return obj.mode == "EDIT" or (obj.mode == "WEIGHT_PAINT" and masked)


def _corners_of_selected_faces(obj: bpy.types.Object) -> Array:
    """(M,) numbers of the points of the faces that are selected and not hidden."""
    faces, loops = obj.data.polygons, obj.data.loops
    chosen, hidden = np.zeros(len(faces), np.bool_), np.zeros(len(faces), np.bool_)
    faces.foreach_get("select", chosen)
    faces.foreach_get("hide", hidden)
    total, corner = np.zeros(len(faces), np.int32), np.zeros(len(loops), np.int32)
    faces.foreach_get("loop_total", total)
    loops.foreach_get("vertex_index", corner)
    return corner[np.repeat(chosen & ~hidden, total)]
