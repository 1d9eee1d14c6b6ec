# SPDX-License-Identifier: GPL-3.0-or-later
"""Two sides of a splat object's weights: before learning, and the result. One is shown, the other is kept.

The shown side is what the vertex groups of the armature's bones hold, whatever an artist paints on it. The other lies
in attributes of the points, so that it travels with the file, with undo and with splats that are removed. Switching
exchanges them, to the bit, and with them whether somebody has changed them by hand.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.influences import Influences
from . import names
from .armature import deform_bone_names
from .attributes import ObjectData, read_attribute, write_attribute
from .binding import bind
from .bone_frames import armature_of, bone_order
from .influences import columns_of, slice_rows, strongest, write_influences
from .splat_object import refuse_edit_mode
from .steps import Steps, run_to_end, slices
from .vertex_groups import GroupsAside, group_state, read_pairs, restore_group_state

Side = Literal["before", "result"]
Array = NDArray[Any]


def compared(obj: bpy.types.Object) -> tuple[str, Side] | None:
    """What the weights are compared with, such as "bone heat", and the side that is shown; None: nothing is kept."""
    record = obj.data.get(names.COMPARED)
    if record is None or names.KEPT_BONE.format(0) not in obj.data.attributes:
        return None
    return str(record["name"]), "before" if record["shown"] == "before" else "result"


def keep(
    obj: bpy.types.Object, name: str, start: Influences, bones: Sequence[str], *, by_hand: bool = False
) -> None:
    """Keep `start`, of the bones `bones`, as what was before the weights that `obj` has now; by_hand: somebody has
    changed them."""
    drop_kept(obj)
    _write_kept(obj.data, start.index, start.value)
    obj.data[names.COMPARED] = {"name": name, "shown": "result", "bones": list(bones), "edited": by_hand}


def mark_edited(obj: bpy.types.Object, edited: bool) -> None:
    """Remember whether somebody changed the weights that are shown since a job or a file gave them."""
    mark = obj.data[names.MARK]
    if edited:
        mark["edited"] = True
    elif "edited" in mark:
        del mark["edited"]


def is_edited(obj: bpy.types.Object) -> bool:
    """Whether somebody changed the weights that are shown since a job or a file gave them."""
    return bool(obj.data[names.MARK].get("edited", False))


def is_kept_edited(obj: bpy.types.Object) -> bool:
    """Whether somebody changed the weights that are kept and not shown."""
    return compared(obj) is not None and bool(obj.data[names.COMPARED].get("edited", False))


def kept_as_it_is(obj: bpy.types.Object) -> tuple[Influences, list[str]]:
    """The weights that are not shown, which are there, and the names of the bones that they number."""
    return Influences(*_read_kept(obj.data)), [str(bone) for bone in obj.data[names.COMPARED]["bones"]]


def kept_influences(obj: bpy.types.Object, bones: Sequence[str]) -> Influences:
    """The weights that are not shown, which are there, by their places in `bones`.

    Raises InputError: they are for bones that are not among `bones`.
    """
    found, kept = kept_as_it_is(obj)
    place = {name: number for number, name in enumerate(bones)}
    gone = [kept[bone] for bone in np.unique(found.index[found.value > 0]) if kept[bone] not in place]
    if gone:
        raise InputError(
            f"The other weights of '{obj.name}' are for bone '{gone[0]}', which its armature has no more as a deform "
            "bone; give it back its name, or run Auto-Skin again."
        )
    return Influences(np.array([place.get(name, 0) for name in kept], np.int32)[found.index], found.value)


def kept_side(obj: bpy.types.Object, bones: Sequence[str]) -> Array | None:
    """(N, B) float32: the weights that are not shown, for `bones`; None where nothing is kept.

    Raises InputError as `kept_influences` does.
    """
    return None if compared(obj) is None else kept_influences(obj, bones).dense(len(bones))


def drop_kept(obj: bpy.types.Object) -> None:
    """Forget what is kept: other weights come, to which it is no counterpart."""
    data: ObjectData = obj.data
    if names.COMPARED in data:
        del data[names.COMPARED]
    _drop_slots(data, 0)


def show_side(obj: bpy.types.Object, side: Side) -> None:
    """Let the vertex groups of the armature's bones hold `side`, and keep what they held; nothing where they do.

    Raises InputError: nothing is kept, no armature, Edit Mode, or bones of the kept side that are not there any more.
    Nothing is changed then.
    """
    now, armature = compared(obj), armature_of(obj)
    refuse_edit_mode(obj)
    if now is None or armature is None:
        raise InputError(f"'{obj.name}' has no weights to compare with; run Auto-Skin.")
    if now[1] == side:
        return
    deform = deform_bone_names(armature)
    other = kept_influences(obj, deform)
    by_hand, other_by_hand = is_edited(obj), is_kept_edited(obj)
    shown = run_to_end(iter_shown(obj, deform))
    state = group_state(obj)
    with GroupsAside(obj) as groups:
        run_to_end(groups.write(deform, columns_of(other.index, other.value)))
        obj = groups.commit()
    restore_group_state(obj, state)
    _turn_by(obj, armature, deform, other.index, other.value)
    _write_kept(obj.data, shown.index, shown.value)
    obj.data[names.COMPARED] = {"name": now[0], "shown": side, "bones": deform, "edited": by_hand}
    mark_edited(obj, other_by_hand)


def _turn_by(
    obj: bpy.types.Object, armature: bpy.types.Object, bones: Sequence[str], index: Array, value: Array
) -> None:
    """Let the rotation nodes follow weights (N, K) of the bones; see `update_rotation_weights`."""
    width = min(names.INFLUENCES, len(bones))
    best, share = np.zeros((len(index), width), np.int32), np.zeros((len(index), width), np.float32)
    for part in slices(len(index), slice_rows(len(bones))):
        rows = Influences(index[part], value[part]).dense(len(bones))
        best[part], share[part] = strongest(rows, width)
        share[part][~(rows > 0).any(axis=1)] = 0
    write_influences(obj, bone_order(bind(obj, armature)), bones, best, share)


def iter_shown(obj: bpy.types.Object, bones: Sequence[str]) -> Steps[Influences]:
    """All that the vertex groups of `bones` hold, as painted: rows need not sum to 1. In slices."""
    place = {name: number for number, name in enumerate(bones)}
    lookup = np.array([place.get(group.name, -1) for group in obj.vertex_groups] or [-1])
    count = len(obj.data.vertices)
    found = []
    for part in slices(count):
        row, group, weight = read_pairs(obj, part)
        ours = lookup[group] >= 0
        found.append((row[ours] + part.start, lookup[group[ours]], weight[ours]))
        yield part.stop / count
    row, bone, weight = (np.concatenate(parts) for parts in zip(*found, strict=True))
    counts = np.bincount(row, minlength=count)
    slot = np.arange(len(row)) - np.repeat(counts.cumsum() - counts, counts)
    width = max(1, int(counts.max(initial=0)))
    index, value = np.zeros((count, width), np.int32), np.zeros((count, width), np.float32)
    index[row, slot], value[row, slot] = bone, weight
    return Influences(index, value)


def _read_kept(data: ObjectData) -> tuple[Array, Array]:
    """Index and weight (N, K) of the kept side."""
    bones, weights = (list(_slots(data, name)) for name in (names.KEPT_BONE, names.KEPT_WEIGHT))
    width = min(len(bones), len(weights))
    return np.stack(bones[:width], axis=1), np.stack(weights[:width], axis=1)


def _slots(data: ObjectData, name: str) -> Iterator[Array]:
    for slot in itertools.count():
        values = read_attribute(data, name.format(slot))
        if values is None:
            return
        yield values


def _write_kept(data: ObjectData, index: Array, value: Array) -> None:
    for slot in range(index.shape[1]):
        write_attribute(data, names.KEPT_BONE.format(slot), "INT", index[:, slot])
        write_attribute(data, names.KEPT_WEIGHT.format(slot), "FLOAT", value[:, slot])
    _drop_slots(data, index.shape[1])


def _drop_slots(data: ObjectData, first: int) -> None:
    """Remove the slots from `first` on."""
    for slot in itertools.count(first):
        found = [name.format(slot) for name in (names.KEPT_BONE, names.KEPT_WEIGHT)]
        there = [name for name in found if name in data.attributes]
        for name in there:
            data.attributes.remove(data.attributes[name])
        if not there:
            return
