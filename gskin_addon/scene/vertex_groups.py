# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertex groups of many points, exactly and in slices.

Python reaches weights only one by one. What Blender offers instead, to whole arrays and in float32, is to turn an
attribute into a vertex group. The groups are made on a copy of the mesh that no scene shows; the last slice puts it
in the place of the mesh. So nothing half-written is ever seen, saved or left behind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .attributes import ObjectData, write_attribute
from .object_ref import ObjectRef, object_by_uid
from .single_user import sharers
from .steps import Steps

Array = NDArray[Any]

_TEMPORARY = "gskin:weights in the making"


class GroupsAside:
    """New vertex groups for the mesh object `obj`, kept apart until `commit`; leaving the block drops the rest.

    Who works on it in slices must see to it that nobody edits the mesh meanwhile: what `commit` puts in its place
    is the mesh as it was in the beginning, with the new groups.
    """

    def __init__(self, obj: bpy.types.Object) -> None:
        self._target = ObjectRef(obj)
        aside = bpy.data.objects.new(f"{obj.name} Weights", obj.data.copy())
        self._aside, self._mesh = (aside.session_uid, aside.name), aside.data.session_uid

    def __enter__(self) -> GroupsAside:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # By session id: an undo meanwhile makes references invalid, and may bring back what was removed.
        aside = object_by_uid(*self._aside)
        if aside is not None:
            bpy.data.objects.remove(aside)
        mesh = next((mesh for mesh in bpy.data.meshes if mesh.session_uid == self._mesh and not mesh.users), None)
        if mesh is not None:
            bpy.data.meshes.remove(mesh)

    def write(self, bones: Sequence[str], column: Callable[[int], Array]) -> Steps[None]:
        """Replace the groups named `bones`; column(i) gives the weights (N,) of the i-th, 0 for points not in it.

        One slice makes or removes one group.
        """
        active = self._object().data.attributes.active
        active_name = active.name if active is not None else ""
        old = [name for name in bones if name in self._object().vertex_groups]
        total = len(old) + len(bones)
        for done, name in enumerate(old):
            groups = self._object().vertex_groups
            groups.remove(groups[name])
            yield (done + 1) / total
        for bone, name in enumerate(bones):
            _add_group(self._object(), name, column(bone))
            yield (len(old) + bone + 1) / total
        attributes = self._object().data.attributes
        attributes.active = attributes.get(active_name)

    def check(self) -> bpy.types.Object:
        """The object, if `commit` can be done. Raises InputError where it was deleted or changed meanwhile."""
        return self._target.find()

    def commit(self) -> bpy.types.Object:
        """Give the object the new groups, and all that share its mesh, or a mesh of its own where it moves others.

        Gives the object.

        Raises InputError as `check` does; nothing is written then.
        """
        obj = self.check()
        aside = self._object()
        old: ObjectData = obj.data
        mesh: ObjectData = aside.data
        name = old.name
        mode = leave_paint_mode(obj)
        mesh.use_fake_user = old.use_fake_user
        bpy.data.objects.remove(aside)
        if sharers(obj):
            obj.data = mesh
        else:
            old.user_remap(mesh)
            bpy.data.meshes.remove(old)
            mesh.name = name
        if mode != "OBJECT":
            set_mode(obj, mode)
        return obj

    def _object(self) -> bpy.types.Object:
        self.check()
        aside = object_by_uid(*self._aside)
        if aside is None:
            name = self._target.name
            raise InputError(f"An undo took away the weights of '{name}' in the making; start again.")
        return aside


def read_pairs(obj: bpy.types.Object, part: slice) -> tuple[Array, Array, Array]:
    """Weights of the points `part`, as stored: row (M,) from 0 on, vertex group (M,) and weight (M,) float32."""
    groups = [vertex.groups for vertex in obj.data.vertices[part]]
    counts = np.fromiter(map(len, groups), dtype=np.int64, count=len(groups))
    ends = counts.cumsum()
    total = int(ends[-1]) if len(ends) else 0
    group, weight = np.empty(total, dtype=np.int32), np.empty(total, dtype=np.float32)
    first = 0
    for elements, end in zip(groups, ends.tolist(), strict=True):
        if end > first:
            elements.foreach_get("group", group[first:end])
            elements.foreach_get("weight", weight[first:end])
            first = end
    return np.repeat(np.arange(len(groups)), counts), group, weight


def group_state(obj: bpy.types.Object) -> tuple[str, frozenset[str]]:
    """The active vertex group ("" for none) and the locked ones, by name, for `restore_group_state`."""
    groups: Any = obj.vertex_groups
    active = groups.active.name if groups.active is not None else ""
    return active, frozenset(group.name for group in groups if group.lock_weight)


def restore_group_state(obj: bpy.types.Object, state: tuple[str, frozenset[str]]) -> None:
    """Groups that were made anew are locked and active as those of their names were."""
    active, locked = state
    for group in obj.vertex_groups:
        group.lock_weight = group.name in locked
    obj.vertex_groups.active_index = max(0, obj.vertex_groups.find(active))


def add_groups(obj: bpy.types.Object, names: Sequence[str], weights: Array) -> None:
    """Vertex groups `names` with the columns of weights (N, K) float32, each point in those where it is above 0."""
    for name, column in zip(names, weights.T, strict=True):
        _add_group(obj, name, column)


def _add_group(obj: bpy.types.Object, name: str, column: Array) -> None:
    """A vertex group with the weights `column` (N,) float32 where they are above 0."""
    if not (column > 0).any():
        obj.vertex_groups.new(name=name)
        return
    attributes = obj.data.attributes
    write_attribute(obj.data, _TEMPORARY, "FLOAT", column)
    attributes.active = attributes[_TEMPORARY]
    # What is being edited meanwhile is another object, but the operator would refuse for it.
    with bpy.context.temp_override(object=obj, edit_object=None):
        bpy.ops.geometry.attribute_convert(mode="VERTEX_GROUP")
    # Under its own name from the start it would clash with attributes: bones may be called "rotation".
    obj.vertex_groups[_TEMPORARY].name = name


def leave_paint_mode(obj: bpy.types.Object) -> str:
    """Paint modes keep pointers into the mesh. Gives the mode that the object was in."""
    mode = obj.mode
    if mode != "OBJECT":
        set_mode(obj, "OBJECT")
    return mode


def set_mode(obj: bpy.types.Object, mode: Any) -> None:
    """Switch the object, which need not be the active one, to a mode."""
    with bpy.context.temp_override(object=obj, active_object=obj):
        bpy.ops.object.mode_set(mode=mode)
