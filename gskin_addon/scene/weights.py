# SPDX-License-Identifier: GPL-3.0-or-later
"""Skinning weights of splat objects as vertex groups, and the strongest of them as attributes that turn the splats.

What takes long for many splats comes as a generator, `iter_...`, that works in slices (`steps.py`), and as a plain
function that runs it to the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.influences import Influences
from . import names
from .armature import deform_bone_names
from .attributes import write_attribute
from .binding import bind, check_splats, iter_prepare, set_parent, show_posed_in_edit_mode
from .bone_frames import (
    armature_modifier,
    armature_of,
    bone_order,
    ensure_bone_frames,
    find_bone_frames,
    is_outdated,
)
from .compared import drop_kept, keep, mark_edited
from .influences import columns_of, rest_is_kept, slice_rows, strongest, turns_by, write_influences
from .object_ref import ObjectRef, object_by_uid
from .overlay import follow_weights
from .probes import follow_stack, is_probed_rightly, iter_prepare_probes, needs_probes, put_before_display
from .rotation_nodes import add_rotation, find_rotation, frames_of
from .single_user import own_mesh, sharers
from .splat_object import is_splat_object, refuse_edit_mode
from .steps import SLICE, Steps, part_of, run_to_end, slices
from .vertex_groups import GroupsAside, group_state, read_pairs, restore_group_state

Array = NDArray[Any]


def write_weights(
    obj: bpy.types.Object,
    armature: bpy.types.Object,
    weights: Array,
    bones: Sequence[str] | None = None,
    *,
    max_influences: int = 4,
    confidence: Array | None = None,
    start: tuple[str, Influences] | None = None,
) -> None:
    """Bind `obj` to `armature` with `weights` (N, B) as vertex groups named after the bones.

    bones: the B bone names of the weights' columns (default: the armature's deform bones). Every splat keeps its
    `max_influences` strongest bones (0: all of them), normalised; the nodes turn splats by the four strongest. Vertex
    groups of the armature's bones are replaced, other groups stay. confidence: (N,) in 0..1, how sure the weights are;
    without it an earlier one is removed. start: what to compare the weights with (`compared.py`), its name and its
    strongest bones; without it an earlier one is removed.
    One call inside an operator is one undo step. The object gets a new mesh datablock in place of its own, of the same
    name.

    Raises InputError: shapes that do not match, NaN, bones that the armature lacks or that do not deform,
    non-uniform object scale, an object in Edit Mode.
    """
    run_to_end(
        iter_write_weights(
            obj, armature, weights, bones, max_influences=max_influences, confidence=confidence, start=start
        )
    )


def iter_write_weights(
    obj: bpy.types.Object,
    armature: bpy.types.Object,
    weights: Array,
    bones: Sequence[str] | None = None,
    *,
    max_influences: int = 4,
    confidence: Array | None = None,
    start: tuple[str, Influences] | None = None,
) -> Steps[None]:
    """`write_weights` in slices. Only the last one changes the scene; closing it before leaves all as it was.

    Raises InputError also where an object is deleted or changed meanwhile; nothing is written then.
    """
    with NewWeights(
        obj, armature, weights, bones, max_influences=max_influences, confidence=confidence, start=start
    ) as new:
        yield from part_of(iter_prepare(armature), 0.0, 0.1)
        yield from part_of(new.make(), 0.1, 1.0)
        new.commit()


class NewWeights:
    """Weights for a splat object, as `write_weights` takes them: made aside in slices, then committed at once.

    A context manager; what is not committed when the block ends is dropped.

    Raises InputError as `write_weights` does.
    """

    def __init__(
        self,
        obj: bpy.types.Object,
        armature: bpy.types.Object,
        weights: Array,
        bones: Sequence[str] | None = None,
        *,
        max_influences: int = 4,
        confidence: Array | None = None,
        start: tuple[str, Influences] | None = None,
    ) -> None:
        self._deform = deform_bone_names(armature)
        bones = list(self._deform if bones is None else bones)
        check_weights(obj, armature, weights, bones)
        check_splats(obj)
        self._name, self._armature = obj.name, (armature.session_uid, armature.name)
        self._weights, self._confidence = weights, confidence
        self._start, self._bones = start, bones
        place = {name: column for column, name in enumerate(bones)}
        self._columns = [place.get(name, -1) for name in self._deform]
        width = min(max_influences or len(self._deform), len(self._deform))
        self._index = np.zeros((len(weights), width), dtype=np.int32)
        self._value = np.zeros((len(weights), width), dtype=np.float32)
        self._groups = GroupsAside(obj)

    def __enter__(self) -> NewWeights:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._groups.__exit__(kind, error, trace)

    def make(self) -> Steps[None]:
        """Find every splat's strongest bones and make the vertex groups. Raises InputError for NaN."""
        yield from part_of(self._choose(), 0.0, 0.3)
        columns = columns_of(self._index, self._value)
        yield from part_of(self._groups.write(self._deform, columns), 0.3, 1.0)

    def check(self) -> tuple[bpy.types.Object, bpy.types.Object]:
        """Splats and armature, if `commit` can be done. Raises InputError where either is not what it was."""
        obj = self._groups.check()
        check_splats(obj)
        uid, name = self._armature
        armature = object_by_uid(uid, name)
        if armature is None or deform_bone_names(armature) != self._deform:
            raise InputError(
                f"Armature '{name}' was deleted or changed while weights for '{self._name}' were worked on; "
                "nothing was written, start again."
            )
        return obj, armature

    def commit(self, *, carried: bool = False) -> None:
        """Put all of it into the scene. With `carried` a mesh moves the splats: they get no modifiers for it.

        Raises InputError as `check` does; nothing is written then.
        """
        # What may refuse comes first, and before the new mesh, which would have to be evaluated at once.
        obj, armature = self.check()
        state = group_state(obj)
        if carried:
            set_parent(obj, armature)
        else:
            bind(obj, armature)
        self._groups.commit()
        restore_group_state(obj, state)
        write_influences(obj, self._deform, self._deform, self._index, self._value)
        if not carried:
            follow_stack(obj)  # the mesh is another than where it was bound
        if self._confidence is not None:
            write_attribute(obj.data, names.CONFIDENCE, "FLOAT", self._confidence)
        elif names.CONFIDENCE in obj.data.attributes:
            obj.data.attributes.remove(obj.data.attributes[names.CONFIDENCE])
        if self._start is None or carried:
            drop_kept(obj)
        else:
            keep(obj, *self._start, self._bones)
        mark_edited(obj, False)
        if not carried:
            follow_weights(obj)

    def _choose(self) -> Steps[None]:
        bones, columns = len(self._deform), np.array(self._columns)
        used = columns >= 0
        as_they_are = np.array_equal(columns, np.arange(np.shape(self._weights)[1]))
        for part in slices(len(self._weights), slice_rows(bones)):
            given = np.asarray(self._weights[part])
            if not np.isfinite(given).all() or np.min(given, initial=0) < -1e-6:
                raise InputError(
                    f"The weights for '{self._name}' have NaN or negative values; make them again."
                )
            if as_they_are:
                rows = given.astype(np.float32, copy=False)
            else:
                rows = np.zeros((len(given), bones), dtype=np.float32)
                rows[:, used] = given[:, columns[used]]
            self._index[part], self._value[part] = strongest(rows, self._index.shape[1])
            yield part.stop / len(self._weights)


def check_weights(
    obj: bpy.types.Object, armature: bpy.types.Object, weights: Array, bones: Sequence[str]
) -> None:
    """Raises InputError where weights (N, B) of the B `bones` are not for these splats and this armature."""
    count = len(obj.data.vertices) if is_splat_object(obj) else 0
    if np.shape(weights) != (count, len(bones)):
        raise InputError(
            f"The weights have shape {np.shape(weights)} and '{obj.name}' has {count} splats for {len(bones)} bones; "
            "use weights that were made for these splats and this armature."
        )
    deform = set(deform_bone_names(armature))
    missing = [bone for bone in bones if bone not in deform]
    if missing:
        raise InputError(
            f"Armature '{armature.name}' has no deform bone '{missing[0]}', for which there are weights; "
            "choose the armature that the weights were made with."
        )


def read_weights(obj: bpy.types.Object, bones: Sequence[str] | None = None) -> tuple[Array, list[str]]:
    """Weights (N, B) float32 of the object's vertex groups as painted, not normalised, and the B bone names.

    bones: default the deform bones of the object's armature; a bone without a vertex group has weight 0.
    Raises InputError where the object follows no armature and no bones are given.
    """
    return run_to_end(iter_read_weights(obj, bones))


def iter_read_weights(
    obj: bpy.types.Object, bones: Sequence[str] | None = None
) -> Steps[tuple[Array, list[str]]]:
    """`read_weights` in slices. Raises InputError also where the object is deleted or changed meanwhile."""
    if bones is None:
        bones = deform_bone_names(_armature_of(obj))
    refuse_edit_mode(obj)
    dense = np.zeros((len(obj.data.vertices), len(bones)), dtype=np.float32)

    def take(part: slice, rows: Array) -> None:
        dense[part] = rows

    yield from _read(ObjectRef(obj), bones, SLICE, take)
    return dense, list(bones)


def update_rotation_weights(obj: bpy.types.Object) -> None:
    """Take over vertex groups into the attributes by which the rotation nodes turn the splats, where they differ.

    Also follows changes of the armature: other bones, deform switched on or off, another armature in the modifier. The
    upkeep in `handlers.py` calls it after every edit. Raises InputError where the object follows no armature.
    """
    run_to_end(iter_update_rotation_weights(obj))


def iter_update_rotation_weights(obj: bpy.types.Object) -> Steps[bool]:
    """`update_rotation_weights` in slices; whether anything was to be changed. Only the last one changes the scene.

    Raises InputError also where the object is deleted or changed meanwhile; nothing is written then.
    """
    bones = deform_bone_names(_armature_of(obj))
    check_splats(obj)
    ref = ObjectRef(obj)
    count, width = len(obj.data.vertices), min(names.INFLUENCES, len(bones))
    index = np.zeros((count, width), dtype=np.int32)
    value = np.zeros((count, width), dtype=np.float32)

    def take(part: slice, rows: Array) -> None:
        index[part], value[part] = strongest(rows, width)
        value[part][~(rows > 0).any(axis=1)] = 0

    yield from _read(ref, bones, slice_rows(len(bones)), take)
    obj = ref.find()
    armature = _armature_of(obj)
    changed = not turns_by(obj, bones, index, value)
    frames = find_bone_frames(armature)
    as_it_was = not changed and frames is not None and frames_of(obj) == frames and rest_is_kept(obj)
    if as_it_was and not needs_probes(obj) and is_probed_rightly(obj):
        return False
    yield from iter_prepare_probes(obj)
    obj = ref.find()
    if as_it_was:
        follow_stack(obj)  # of weights beyond the strongest, and of other armatures, nothing above knows
        return True
    frames = ensure_bone_frames(armature)
    modifier = armature_modifier(obj)
    put_before_display(obj)
    if find_rotation(obj) is None:
        show_posed_in_edit_mode(modifier)
    add_rotation(obj, frames, modifier)
    if any(bone_order(other) != bone_order(frames) for other in _frames_of_sharers(obj)):
        own_mesh(obj)  # the bones are stored by their number, which means another bone there
    write_influences(obj, bone_order(frames), bones, index, value)
    follow_stack(obj)
    if changed:
        mark_edited(obj, True)
        follow_weights(obj)
    return True


def follows_foreign_frames(obj: bpy.types.Object) -> bool:
    """Whether one armature moves the splats and another one turns them."""
    armature, frames = armature_of(obj), frames_of(obj)
    return frames is not None and armature is not None and armature_of(frames) != armature


def repoint_frames(obj: bpy.types.Object) -> bool:
    """Let the armature that moves the splats turn them too, if the stored bones mean the same there; True if so."""
    armature, frames = armature_of(obj), frames_of(obj)
    # Layouts with joints of bendy bones may differ where names do not.
    if bone_order(frames) != deform_bone_names(armature) or is_outdated(frames, armature):
        return False
    add_rotation(obj, ensure_bone_frames(armature), armature_modifier(obj))
    follow_stack(obj)
    return True


def _frames_of_sharers(obj: bpy.types.Object) -> list[bpy.types.Object]:
    found = [frames_of(bpy.data.objects[name]) for name in sharers(obj)]
    return [frames for frames in found if frames is not None]


def _armature_of(obj: bpy.types.Object) -> bpy.types.Object:
    armature = armature_of(obj)
    if armature is None:
        raise InputError(f"'{obj.name}' follows no armature; bind it to one first.")
    return armature


def _read(
    ref: ObjectRef, bones: Sequence[str], size: int, take: Callable[[slice, Array], None]
) -> Steps[None]:
    """Give `take` the weights (n, B) of all splats, at most `size` at a time."""
    place = {name: index for index, name in enumerate(bones)}
    groups = [group.name for group in ref.find().vertex_groups]
    lookup = np.array([place.get(name, -1) for name in groups] or [-1])
    count = len(ref.find().data.vertices)
    for part in slices(count, size):
        row, group, weight = read_pairs(ref.find(), part)
        column = lookup[group]
        known = column >= 0
        rows = np.zeros((part.stop - part.start, len(bones)), dtype=np.float32)
        rows[row[known], column[known]] = weight[known]
        take(part, rows)
        yield part.stop / count
        if [group.name for group in ref.find().vertex_groups] != groups:
            raise InputError(f"The vertex groups of '{ref.name}' were changed while they were read; start again.")
