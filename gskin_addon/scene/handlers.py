# SPDX-License-Identifier: GPL-3.0-or-later
"""What follows an artist's edits by itself; never needed for posing, playback or rendering.

After Weight Paint the rotation nodes get the painted weights, in slices while Blender goes on; a copy of splats
together with their armature is turned by its own armature; segments given to bones get their frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import bpy
from bpy.app.handlers import persistent

from ..core.errors import GSkinError
from .bone_frames import armature_of, is_outdated
from .object_ref import object_by_uid
from .rotation_nodes import frames_of
from .splat_object import is_splat_object
from .steps import Steps, run_for, run_to_end
from .weights import follows_foreign_frames, iter_update_rotation_weights, repoint_frames

CLASSES = ()

BUDGET = 0.04
"""Seconds of slices in one call of the timer."""
PAUSE = 0.02
"""Seconds between two calls, for Blender to draw and listen in."""

_changed: set[int] = set()
"""Session ids of splat objects whose weights are to be taken over: painted on, or copied."""
_running: dict[int, Steps[None]] = {}
"""Those of which some slices are done. Only the last slice changes the scene."""
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
            if isinstance(update.id, bpy.types.Armature):
                _changed.update(_outdated_by(update.id.original))
            if not isinstance(update.id, bpy.types.Object):
                continue
            obj = update.id.original
            if not is_splat_object(obj) or frames_of(obj) is None:
                continue
            if painting and obj.mode == "WEIGHT_PAINT" and update.is_updated_geometry:
                _ask_again(obj.session_uid)
            if obj.session_uid not in _running and follows_foreign_frames(obj):
                _guarded(_repair, obj)
        if _changed and not painting:
            _begin()
    finally:
        _busy = False


@contextmanager
def paused() -> Iterator[None]:
    """Inside the block changes of the scene are none of an artist's; `follow_edits` does not look at them."""
    global _busy
    before, _busy = _busy, True
    try:
        yield
    finally:
        bpy.context.view_layer.update()
        _busy = before


@persistent
def take_over_paint(*_: object) -> None:
    """Update the rotation weights of all painted objects now: at once, not in slices."""
    for uid in [*_running]:
        _ask_again(uid)
    for uid in [*_changed]:
        obj = _followed(uid)
        if obj is not None:
            _guarded(lambda obj: run_to_end(iter_update_rotation_weights(obj)), obj)
    _changed.clear()


@persistent
def read_again(*_: object) -> None:
    """After an undo or redo the weights that were being read are others."""
    for uid in [*_running]:
        _ask_again(uid)
    if _changed and bpy.context.mode != "PAINT_WEIGHT":
        _begin()


@persistent
def forget(*_: object) -> None:
    """Another file: session ids mean nothing any more."""
    _changed.clear()
    _running.clear()


def _ask_again(uid: int) -> None:
    steps = _running.pop(uid, None)
    if steps is not None:
        steps.close()
    _changed.add(uid)


def _begin() -> None:
    """Take the changed weights over: at once where nobody watches, else in slices from a timer."""
    if not _watched():
        take_over_paint()
        return
    for uid in [*_changed]:
        obj = _followed(uid)
        if obj is not None and obj.mode in {"EDIT", "WEIGHT_PAINT"}:
            continue  # the next change after leaving it comes here again
        _changed.discard(uid)
        if obj is not None:
            _running[uid] = iter_update_rotation_weights(obj)
    if _running and not bpy.app.timers.is_registered(_go_on):
        bpy.app.timers.register(_go_on, first_interval=0.0)


def _watched() -> bool:
    return not bpy.app.background


def _go_on() -> float | None:
    """One call of the timer: seconds until the next, None when all is done."""
    global _busy
    _busy = True
    try:
        for uid, steps in [*_running.items()][:1]:
            try:
                run_for(steps, BUDGET)
            except StopIteration:
                _running.pop(uid, None)
            except GSkinError as error:
                _running.pop(uid, None)
                print(f"gskin: {error}")
            except Exception:
                _running.pop(uid, None)
                raise
    finally:
        _busy = False
    return PAUSE if _running else None


def _repair(obj: bpy.types.Object) -> None:
    if not repoint_frames(obj):
        _changed.add(obj.session_uid)


def _outdated_by(armature: bpy.types.Armature) -> list[int]:
    """Splats whose bone frames were made for other segments of their bones, by session id."""
    found = []
    for obj in bpy.data.objects:
        rig = armature_of(obj) if is_splat_object(obj) and obj.library is None else None
        if rig is not None and rig.data == armature and rig.mode != "EDIT":
            frames = frames_of(obj)
            if frames is not None and any(b.use_deform for b in armature.bones) and is_outdated(frames, rig):
                found.append(obj.session_uid)
    return found


def _followed(uid: int) -> bpy.types.Object | None:
    obj = object_by_uid(uid)
    return obj if is_splat_object(obj) and armature_of(obj) is not None else None


def _guarded(work: Callable[[bpy.types.Object], object], obj: bpy.types.Object) -> None:
    # A handler has nobody to report to; the operators say the same to whoever asks for it.
    try:
        work(obj)
    except GSkinError as error:
        print(f"gskin: {error}")


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, follow_edits),
    (bpy.app.handlers.save_pre, take_over_paint),
    (bpy.app.handlers.load_post, forget),
    (bpy.app.handlers.undo_post, read_again),
    (bpy.app.handlers.redo_post, read_again),
)


def unregister() -> None:
    if bpy.app.timers.is_registered(_go_on):
        bpy.app.timers.unregister(_go_on)
    forget()
