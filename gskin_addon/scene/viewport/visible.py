# SPDX-License-Identifier: GPL-3.0-or-later
"""What a 3D view shows: the splat objects that the shader draws, with their splats, and what else is there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import bpy
import numpy as np

from ...core.render.drawn_splats import DrawnSplats
from . import selection, switch
from .reading import RestSplats, drawn_limit, is_same, read_edited_rest, read_posed, read_rest
from .selection import hidden_splats

T = TypeVar("T")

_pose_version: dict[int, int] = {}
"""By session id of an object: rises with every change of its evaluated points."""
_rest_version: dict[int, int] = {}
_rest: dict[int, Known[RestSplats]] = {}
_posed: dict[int, Known[DrawnSplats]] = {}


@dataclass(frozen=True)
class Known(Generic[T]):
    """What was read last: for what state of the scene, by which name it is known to what is drawn of it, and itself.

    Entering and leaving Edit Mode changes the state and not the splats: they keep the name, so that nothing is sorted
    or drawn anew.
    """

    state: Any
    name: Any
    read: T | None


@dataclass(frozen=True)
class Shown:
    """An object to draw: what its rest splats and its posed splats are known by, and the splats in the world.

    obj: what a click selects; of instances the object that makes them.
    """

    obj: bpy.types.Object
    rest_key: Any
    pose_key: Any
    splats: DrawnSplats


def is_visible(obj: bpy.types.Object, layer: bpy.types.ViewLayer, space: Any) -> bool:
    """Whether a view shows an object: collections, local view and the eye in the outliner."""
    return obj.visible_get(view_layer=layer, viewport=space if isinstance(space, bpy.types.SpaceView3D) else None)


def objects_of(layer: bpy.types.ViewLayer) -> Iterator[bpy.types.Object]:
    """The objects of a view layer; it lists None for one that was just deleted."""
    return (obj for obj in layer.objects if obj is not None)


def shown_objects(context: bpy.types.Context) -> list[Shown]:
    """The splat objects that the view shows and whose points are there, read again where they have changed."""
    layer, space = context.view_layer, context.space_data
    if isinstance(space, bpy.types.SpaceView3D) and not space.show_object_viewport_mesh:
        return []
    found = []
    for obj in objects_of(layer):
        if obj.type == "MESH" and switch.is_drawn(obj) and is_visible(obj, layer, space):
            found.append(_read(obj, context))
    if any(obj.instance_type != "NONE" for obj in objects_of(layer)):
        found += _instances(context)
    return [one for one in found if one is not None]


def _instances(context: bpy.types.Context) -> list[Shown | None]:
    """Splats of collections that are instanced: each instance where it is."""
    layer, space = context.view_layer, context.space_data
    places = []
    for instance in layer.depsgraph.object_instances:
        if instance.is_instance and instance.show_self and switch.is_drawn(instance.object.original):
            # What the loop gives is gone with its next round.
            places.append((instance.object.original, instance.parent.original, np.array(instance.matrix_world)))
    found = [(_read(obj, context), parent, place) for obj, parent, place in places if is_visible(parent, layer, space)]
    return [
        None if one is None else replace(one, obj=parent, splats=replace(one.splats, matrix=place.astype(np.float64)))
        for one, parent, place in found
    ]


def _read(obj: bpy.types.Object, context: bpy.types.Context) -> Shown | None:
    evaluated, uid = obj.evaluated_get(context.view_layer.depsgraph), obj.session_uid
    limit = drawn_limit(evaluated)
    before = _rest.get(uid)
    state: Any = (
        uid,
        obj.data.session_uid,
        _rest_version.get(uid, 0),
        len(obj.data.vertices),
        limit,
        obj.mode == "EDIT",
    )
    if before is None or before.state != state:
        if obj.mode == "EDIT":
            rest = read_edited_rest(evaluated, before.read if before and before.state[-2] == limit else None, limit)
        else:
            rest = read_rest(obj, limit)
        same = before is not None and before.read is not None and rest is not None and before.read.is_same(rest)
        _rest[uid] = Known(state, before.name, before.read) if same and before else Known(state, state, rest)
    known = _rest[uid]
    if known.read is None:
        return None
    hidden, what_hides = hidden_splats(obj)
    state = (known.name, what_hides, _pose_version.get(uid, 0), context.scene.session_uid, context.view_layer.name)
    last = _posed.get(uid)
    if last is None or last.state != state or last.read is None:
        splats = read_posed(evaluated, known.read, limit, hidden)
        same = last is not None and last.read is not None and splats is not None and is_same(last.read, splats)
        _posed[uid] = Known(state, last.name, last.read) if same and last else Known(state, state, splats)
    posed = _posed[uid]
    if posed.read is None or posed.read.count == 0:
        return None
    matrix = np.array(evaluated.matrix_world, np.float64)
    return Shown(obj, (known.name, what_hides), posed.name, replace(posed.read, matrix=matrix))


def others(context: bpy.types.Context) -> Iterator[bpy.types.Object]:
    """What the view shows beside the splats that the shader draws."""
    layer, space = context.view_layer, context.space_data
    return (obj for obj in objects_of(layer) if not switch.is_drawn(obj) and is_visible(obj, layer, space))


def pose_changed(obj: bpy.types.Object) -> None:
    """Have an object's evaluated points read again."""
    _pose_version[obj.session_uid] = _pose_version.get(obj.session_uid, 0) + 1


def rest_changed(obj: bpy.types.Object) -> None:
    """Have an object's own attributes read again."""
    _rest_version[obj.session_uid] = _rest_version.get(obj.session_uid, 0) + 1


def forget() -> None:
    """Have everything read again. Versions go on rising, so that no key of before comes back.

    What Edit Mode keeps from being read is compared with what is known of it.
    """
    edited = {obj.session_uid for obj in bpy.data.objects if obj.mode == "EDIT"}
    for known in (_rest, _posed):
        for uid in [*known]:
            if uid not in edited:
                del known[uid]
    selection.forget()
    for versions in (_pose_version, _rest_version):
        for uid in versions:
            versions[uid] += 1
