# SPDX-License-Identifier: GPL-3.0-or-later
"""What follows an artist's edits by itself; never needed for posing, playback or rendering.

After Weight Paint the rotation nodes get the painted weights; a copy of splats together with their armature is turned
by its own armature.
"""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from ..core.errors import GSkinError
from .bone_frames import armature_of
from .rotation_nodes import frames_of
from .splat_object import is_splat_object
from .weights import repair_frames, update_rotation_weights

CLASSES = ()

_painted: set[int] = set()
"""Session ids of splat objects that were painted on since they were last taken over."""
_busy = False


@persistent
def follow_edits(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Look at what the last change touched; costs microseconds where it was nothing of ours."""
    global _busy
    if _busy:
        return
    _busy = True
    try:
        painting = bpy.context.mode == "PAINT_WEIGHT"
        for update in depsgraph.updates:
            if not isinstance(update.id, bpy.types.Object):
                continue
            obj = update.id.original
            if not is_splat_object(obj) or frames_of(obj) is None:
                continue
            if painting and obj.mode == "WEIGHT_PAINT" and update.is_updated_geometry:
                _painted.add(obj.session_uid)
            if armature_of(frames_of(obj)) != armature_of(obj):
                _guarded(repair_frames, obj)
        if _painted and not painting:
            take_over_paint()
    finally:
        _busy = False


@persistent
def take_over_paint(*_: object) -> None:
    """Update the rotation weights of all painted objects."""
    for obj in [obj for obj in bpy.data.objects if obj.session_uid in _painted]:
        if is_splat_object(obj) and armature_of(obj) is not None:
            _guarded(update_rotation_weights, obj)
    _painted.clear()


@persistent
def forget(*_: object) -> None:
    """Another file: session ids mean nothing any more."""
    _painted.clear()


def _guarded(work, obj: bpy.types.Object) -> None:
    # A handler has nobody to report to; the operators say the same to whoever asks for it.
    try:
        work(obj)
    except GSkinError as error:
        print(f"gskin: {error}")


_HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, follow_edits),
    (bpy.app.handlers.save_pre, take_over_paint),
    (bpy.app.handlers.load_post, forget),
)


def register() -> None:
    for where, handler in _HANDLERS:
        where.append(handler)


def unregister() -> None:
    for where, handler in _HANDLERS:
        if handler in where:
            where.remove(handler)
