# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights of splats in Edit Mode, written to what is edited: Edit Mode need not be left and entered again for them,
which takes Blender a second for 150,000 splats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bmesh
import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .attributes import ObjectData
from .compared import mark_edited
from .object_ref import object_by_uid
from .steps import Steps, slices

Array = NDArray[Any]


class EditedRef:
    """A splat object in Edit Mode by its session id, with the mesh and the number of points that it has there."""

    def __init__(self, obj: bpy.types.Object) -> None:
        self.uid, self.name = obj.session_uid, obj.name
        self._mesh, self._count = obj.data.session_uid, len(bmesh.from_edit_mesh(_data(obj)).verts)

    def find(self) -> bpy.types.Object:
        """The object. Raises InputError where it is another now, or in another mode."""
        obj = object_by_uid(self.uid, self.name)
        same = obj is not None and obj.mode == "EDIT" and obj.data.session_uid == self._mesh
        if obj is None or not same or len(bmesh.from_edit_mesh(_data(obj)).verts) != self._count:
            raise InputError(
                f"'{self.name}' was changed while its weights were worked on; nothing was written, start again."
            )
        return obj


def iter_write_edited(ref: EditedRef, bones: Sequence[str], before: Array, after: Array) -> Steps[None]:
    """Write weights after (N, B) of the bones, where they are not those of `before`, to what is edited, in slices; and
    `before` again where these are given up.

    What turns the splats is made of them when Edit Mode ends (`handlers.py`). Raises InputError as `EditedRef.find`.
    """
    row, column = np.nonzero(after != before)
    obj = ref.find()
    for bone in np.unique(column).tolist():
        if bones[bone] not in obj.vertex_groups:
            obj.vertex_groups.new(name=bones[bone])
    group = np.array([obj.vertex_groups[name].index if name in obj.vertex_groups else -1 for name in bones])
    yield 0.0
    done = 0
    try:
        for part in slices(len(row)):
            _write_edited(ref.find(), row[part], group[column[part]], after[row[part], column[part]])
            done = part.stop
            yield done / len(row)
    except BaseException:  # also a generator that is closed
        for part in slices(done):
            _write_edited(ref.find(), row[part], group[column[part]], before[row[part], column[part]])
        raise
    mark_edited(obj, True)
    # Once for all slices: the view is drawn again after each.
    bmesh.update_edit_mesh(_data(obj), loop_triangles=False, destructive=False)


def _write_edited(obj: bpy.types.Object, row: Array, group: Array, weight: Array) -> None:
    """Give points (K,) of what is edited weights (K,) in groups (K,); 0 takes them out of the group."""
    work = bmesh.from_edit_mesh(_data(obj))
    layer, verts = work.verts.layers.deform.verify(), work.verts
    verts.ensure_lookup_table()
    last, groups = -1, None
    for point, number, value in zip(row.tolist(), group.tolist(), weight.tolist(), strict=True):
        if point != last:
            last, groups = point, verts[point][layer]
        if value > 0:
            groups[number] = value
        elif number in groups:
            del groups[number]


def _data(obj: bpy.types.Object) -> ObjectData:
    return obj.data
