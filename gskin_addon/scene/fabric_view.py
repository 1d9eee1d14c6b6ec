# SPDX-License-Identifier: GPL-3.0-or-later
"""When the fabric under splats is seen: in Weight Paint and Edit Mode, in place of the display, and nowhere else.

Where the shader draws the splats there, too, the display stays: its bare points leave the cage to Blender.
"""

from __future__ import annotations

from typing import Any

import bpy
from bpy.app.handlers import persistent

from .fabric import has_fabric
from .node_groups import find_display
from .rotation_nodes import find_rotation, rest_in_edit_mode
from .splat_object import is_splat_object
from .viewport import switch

CLASSES = ()

MODES = {"WEIGHT_PAINT", "EDIT"}
"""Modes of an object in which its fabric is seen."""

_AWAY = "gskin_display_away"
"""Custom property of an object whose display is off because its fabric is seen."""
_owner = object()  # of the subscription to changes of the mode


def apply_to(obj: bpy.types.Object) -> None:
    """Bring what is seen of an object in line with its mode; nothing is touched where it is so already."""
    modifier = find_display(obj)
    if modifier is None or obj.library is not None:
        return
    away = obj.mode in MODES and has_fabric(obj) and not switch.shall_draw(obj)
    if away and modifier.show_viewport:
        modifier.show_viewport, obj[_AWAY] = False, True
    elif not away and obj.get(_AWAY) is not None:
        modifier.show_viewport = True
        del obj[_AWAY]


def apply_to_all() -> None:
    """Bring all splat objects in line with their modes."""
    for obj in bpy.data.objects:
        if is_splat_object(obj):
            apply_to(obj)


@persistent
def follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """After any change; microseconds where no splat object changed."""
    for update in depsgraph.updates:
        obj = update.id.original if isinstance(update.id, bpy.types.Object) else None
        if is_splat_object(obj):
            apply_to(obj)


@persistent
def start_over(*_: object) -> None:
    """After undo, redo or another file; a file may have been saved in a paint mode."""
    _subscribe()
    apply_to_all()


@persistent
def look_at_file(*_: object) -> None:
    """What turns splats ran in Edit Mode, too, in files of older versions."""
    for obj in bpy.data.objects:
        rotation = find_rotation(obj) if is_splat_object(obj) and obj.library is None else None
        if rotation is not None and not switch.is_drawn(obj):
            rest_in_edit_mode(rotation)
    start_over()


def _subscribe() -> None:
    bpy.msgbus.clear_by_owner(_owner)
    key: Any = (bpy.types.Object, "mode")
    bpy.msgbus.subscribe_rna(key=key, owner=_owner, args=(), notify=apply_to_all)


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, follow),
    (bpy.app.handlers.undo_post, start_over),
    (bpy.app.handlers.redo_post, start_over),
    (bpy.app.handlers.load_post, look_at_file),
)


def register() -> None:
    _subscribe()


def unregister() -> None:
    bpy.msgbus.clear_by_owner(_owner)
    for obj in getattr(bpy.data, "objects", ()):
        modifier = find_display(obj) if obj.get(_AWAY) is not None else None
        if modifier is not None:
            modifier.show_viewport = True
            del obj[_AWAY]
