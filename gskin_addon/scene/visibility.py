# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that are hidden, switched off or not selectable, made workable for a while.

Blender evaluates nothing of an object in an excluded or switched-off collection, or with its own switch off: its pose
is the one of long ago, and after loading a file not even its place in the world is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import bpy

_NAME = "GSkin Shown"
_SWITCHES = ("hide_viewport", "hide_render", "hide_select")


@contextmanager
def shown(
    objects: Sequence[bpy.types.Object | None], *, select: bool = False, render: bool = False
) -> Iterator[None]:
    """Inside the block these objects (None is left out) are evaluated; after it all is as it was.

    With `select` they are also visible and selectable, with `render` they are rendered.
    """
    layer = bpy.context.view_layer
    lacking = [obj for obj in dict.fromkeys(objects) if obj is not None and not _workable(obj, layer, select, render)]
    if not lacking:
        yield
        return
    collection = bpy.data.collections.new(_NAME)
    bpy.context.scene.collection.children.link(collection)
    switches = [(obj, name, getattr(obj, name)) for obj in lacking for name in _SWITCHES]
    for obj in lacking:
        collection.objects.link(obj)
        obj.hide_viewport = obj.hide_select = False
        if render:
            obj.hide_render = False
    layer.update()
    eyes = [(obj, obj.hide_get(view_layer=layer)) for obj in lacking]
    for obj in lacking:
        obj.hide_set(False, view_layer=layer)
    layer.update()
    try:
        yield
    finally:
        present: Any = layer.objects
        for obj, hidden in eyes:
            if present.get(obj.name) == obj:
                obj.hide_set(hidden, view_layer=layer)
        for obj, name, value in switches:
            if getattr(obj, name) != value:
                setattr(obj, name, value)
        bpy.data.collections.remove(collection)
        layer.update()


def _workable(obj: bpy.types.Object, layer: bpy.types.ViewLayer, select: bool, render: bool) -> bool:
    if not obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).is_evaluated:
        return False
    if select and (layer.objects.get(obj.name) != obj or obj.hide_select or not obj.visible_get(view_layer=layer)):
        return False
    return not render or not (obj.hide_render or all(c.hide_render for c in obj.users_collection))
