# SPDX-License-Identifier: GPL-3.0-or-later
"""What keeps splats turned by the weights and bones that they have, whatever an artist does; never needed for posing,
playback or rendering.

Blender names in each update the meshes whose data was touched: by brushes, Edit Mode, any tool of vertex groups,
scripts, undo, redo, files. The weights of those are compared with what turns the splats, and taken over where they
differ: in slices while Blender goes on, once painting or editing has ended, or once a stroke has where the splats are
seen while weights are painted. Bones that come, go, or get segments are noticed by the armature; a copy of splats
together with their armature is turned by its own; splats that get an Armature modifier by hand get the rotation nodes
too; where the armature is gone, nodes and helper go.

What is written here is made of the weights alone, so that it needs no undo step of its own: whatever state undo brings
back, it is compared anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import bpy
from bpy.app.handlers import persistent

from ..core.errors import GSkinError
from .anchor_nodes import find_anchor
from .bone_frames import armature_of
from .leftovers import clean, clean_later, fits
from .object_ref import object_by_uid
from .probes import is_probed_rightly
from .rotation_nodes import find_rotation, frames_of
from .splat_object import is_splat_object
from .stand_in import is_stand_in
from .steps import Steps, run_for, run_to_end
from .transforms import within_update
from .viewport import switch
from .weights import follows_foreign_frames, iter_update_rotation_weights, repoint_frames

CLASSES = ()

BUDGET = 0.04
"""Seconds of slices in one call of the timer."""
PAUSE = 0.02
"""Seconds between two calls, for Blender to draw and listen in."""

QUIET = 0.3
"""Seconds without a change after which a stroke counts as ended."""

AT_WORK = {"EDIT", "WEIGHT_PAINT"}
"""Modes of splats in which weights are still being changed, and nobody sees how they are turned, unless the shader
draws them in Weight Paint."""

_changed: set[int] = set()
"""Session ids of splat objects whose weights are to be compared with what turns them."""
_running: dict[int, Steps[bool]] = {}
"""Those of which some slices are done. Only the last slice changes the scene."""
_groups: dict[int, tuple[str, ...]] = {}
"""By session id: the vertex groups seen last. Removing one touches no mesh in every version of Blender."""
_busy = False


@persistent
def follow_edits(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Look at what the last change touched; costs microseconds where it was nothing of ours."""
    global _busy
    if _busy:
        return
    _busy = True
    try:
        updates = list(depsgraph.updates)
        meshes = {
            update.id.original.session_uid
            for update in updates
            if isinstance(update.id, bpy.types.Mesh) and update.is_updated_geometry
        }
        for update in updates:
            if isinstance(update.id, bpy.types.Armature):
                _changed.update(_outdated_by(update.id.original))
            elif isinstance(update.id, bpy.types.Object) and is_splat_object(update.id.original):
                with within_update():
                    _look_at(update.id.original, touched=update.id.original.data.session_uid in meshes)
        if _changed:
            with within_update():
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
    """Compare and take over the weights of all touched objects now: at once, not in slices."""
    global _busy
    if _busy or not (_running or _changed):
        return
    bpy.context.view_layer.update()
    _busy = True
    try:
        for uid in [*_running]:
            _ask_again(uid)
        for uid in [*_changed]:
            settle(object_by_uid(uid), uid)
        bpy.context.view_layer.update()
    finally:
        _busy = False


def settle(obj: bpy.types.Object | None, uid: int = 0) -> None:
    """Take over what was changed of one object, if anything was; one that is in Edit Mode waits for its end."""
    uid = obj.session_uid if obj is not None else uid
    if uid in _running:
        _ask_again(uid)
    if uid not in _changed or (obj is not None and obj.mode == "EDIT"):
        return
    _changed.discard(uid)
    if obj is not None and _is_followed(obj):
        _guarded(lambda obj: run_to_end(iter_update_rotation_weights(obj)), obj)


def is_unsettled(obj: bpy.types.Object) -> bool:
    """Whether something was changed that `settle` would take over."""
    return (obj.session_uid in _changed or obj.session_uid in _running) and obj.mode != "EDIT"


def iter_settle(obj: bpy.types.Object) -> Steps[None]:
    """`settle` in slices; goes on with what the timer began, which goes on with it again where this is given up."""
    if is_stand_in(obj):  # what is edited is followed only when that ends
        yield from iter_update_rotation_weights(obj)
        return
    uid = obj.session_uid
    while is_unsettled(obj):  # again where it was changed meanwhile
        steps = _running.pop(uid, None)
        _changed.discard(uid)
        if steps is None:
            if not _is_followed(obj):
                return
            steps = iter_update_rotation_weights(obj)
        ended = False
        try:
            yield from _as_ours(steps)
            ended = True
        except GSkinError as error:
            print(f"gskin: {error}")  # as in `_guarded`
            ended = True
        finally:
            if not ended:
                _ask_again(uid)
                _begin()


def _as_ours(steps: Steps[bool]) -> Steps[None]:
    """The same slices; what they write is known not to be the artist's."""
    global _busy
    while True:
        # What an artist has changed since comes first, as in `_go_on`.
        bpy.context.view_layer.update()
        _busy = True
        try:
            share = next(steps)
        except StopIteration as stop:
            if stop.value:
                clean()
                bpy.context.view_layer.update()
            return
        finally:
            _busy = False
        yield share


def refresh_all() -> None:
    """Bring all splats of the file in line with their weights and armatures now, as without handlers nobody does."""
    for obj in bpy.data.objects:
        if is_splat_object(obj) and obj.users_scene and obj.mode != "EDIT":
            _look_at(obj, touched=True)
            settle(obj)
    clean()


@persistent
def read_again(*_: object) -> None:
    """After an undo or redo the weights that were being read are others."""
    for uid in [*_running]:
        _ask_again(uid)
    if _changed:
        _begin()


@persistent
def forget(*_: object) -> None:
    """Another file: session ids mean nothing any more."""
    _changed.clear()
    _running.clear()
    _groups.clear()


@persistent
def look_at_file(*_: object) -> None:
    """A file that was loaded may have been changed where the add-on was not there."""
    forget()
    for obj in bpy.data.objects:
        if is_splat_object(obj) and obj.users_scene:
            _look_at(obj, touched=True)
    if _changed:
        _begin()


def _look_at(obj: bpy.types.Object, *, touched: bool) -> None:
    """Note what is to be done about a splat object that was updated; `touched`: its mesh was."""
    if obj.library is not None:
        return
    uid = obj.session_uid
    if armature_of(obj) is None:
        if find_rotation(obj) is not None:
            _let_go(obj)
        return
    groups = tuple(group.name for group in obj.vertex_groups)
    if frames_of(obj) is None:
        # An Armature modifier by hand: splats that go with an armature are turned by it.
        touched = find_anchor(obj) is None and any(_moves(obj, groups))
        if not touched:
            return
    elif _groups.get(uid, groups) != groups:
        touched = True
    _groups[uid] = groups
    if touched:
        _ask_again(uid)
    elif uid not in _running and follows_foreign_frames(obj):
        _guarded(_repair, obj)
    elif uid not in _running and not is_probed_rightly(obj):
        _ask_again(uid)


def _moves(obj: bpy.types.Object, groups: tuple[str, ...]) -> list[str]:
    """The vertex groups of deform bones of the object's armature."""
    armature = armature_of(obj)
    deform = {bone.name for bone in armature.data.bones if bone.use_deform}
    return [name for name in groups if name in deform]


def _let_go(obj: bpy.types.Object) -> None:
    """The armature is gone: the splats are at rest, and what turned them goes too."""
    _changed.discard(obj.session_uid)
    steps = _running.pop(obj.session_uid, None)
    if steps is not None:
        steps.close()
    clean_later()


def _ask_again(uid: int) -> None:
    steps = _running.pop(uid, None)
    if steps is not None:
        steps.close()
    _changed.add(uid)


def _begin() -> None:
    """Take the changed weights over: at once where nobody watches, else in slices from a timer."""
    watched = _watched()
    for uid in [*_changed]:
        obj = object_by_uid(uid)
        if obj is not None and obj.mode in AT_WORK and not is_seen_while_painted(obj):
            continue  # the next change after leaving it comes here again
        if obj is not None and obj.mode in AT_WORK and watched:
            _begin_when_quiet()
            continue
        if not watched:
            settle(obj, uid)
            clean_later()
            continue
        _changed.discard(uid)
        if obj is not None and _is_followed(obj):
            _running[uid] = iter_update_rotation_weights(obj)
    if _running and not bpy.app.timers.is_registered(_go_on):
        bpy.app.timers.register(_go_on, first_interval=0.0)


def is_seen_while_painted(obj: bpy.types.Object) -> bool:
    """Whether weights are being painted on splats that are drawn all the same, as their bones turn them."""
    return obj.mode == "WEIGHT_PAINT" and switch.shall_draw(obj)


def _begin_when_quiet() -> None:
    """Each change puts it off again, so that a brush is not held up by what reads its weights."""
    if bpy.app.timers.is_registered(_after_stroke):
        bpy.app.timers.unregister(_after_stroke)
    bpy.app.timers.register(_after_stroke, first_interval=QUIET)


def _after_stroke() -> None:
    """Timer: begin with the splats whose weights are being painted."""
    for uid in [*_changed]:
        obj = object_by_uid(uid)
        if obj is not None and is_seen_while_painted(obj):
            _changed.discard(uid)
            if _is_followed(obj):
                _running[uid] = iter_update_rotation_weights(obj)
    if _running and not bpy.app.timers.is_registered(_go_on):
        bpy.app.timers.register(_go_on, first_interval=0.0)


def _watched() -> bool:
    return not bpy.app.background


def _go_on() -> float | None:
    """One call of the timer: seconds until the next, None when all is done."""
    global _busy
    # What an artist has changed since comes first; then what is written here is known to be ours.
    bpy.context.view_layer.update()
    _busy = True
    try:
        for uid, steps in [*_running.items()][:1]:
            try:
                run_for(steps, BUDGET)
            except StopIteration as stop:
                _running.pop(uid, None)
                if stop.value:
                    clean()
                    bpy.context.view_layer.update()
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
    """Splats whose bone frames were made for other bones or segments, by session id."""
    found = []
    for obj in bpy.data.objects:
        rig = armature_of(obj) if is_splat_object(obj) and obj.library is None else None
        if rig is not None and rig.data == armature and rig.mode != "EDIT":
            frames = frames_of(obj)
            if frames is not None and any(bone.use_deform for bone in armature.bones) and not fits(frames, rig):
                found.append(obj.session_uid)
    return found


def _is_followed(obj: bpy.types.Object) -> bool:
    """Whether an armature moves the splats, and what they have can be written to."""
    return is_splat_object(obj) and armature_of(obj) is not None and obj.data.library is None


def _guarded(work: Callable[[bpy.types.Object], object], obj: bpy.types.Object) -> None:
    # A handler has nobody to report to; the operators say the same to whoever asks for it.
    try:
        work(obj)
    except GSkinError as error:
        print(f"gskin: {error}")


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, follow_edits),
    (bpy.app.handlers.save_pre, take_over_paint),
    (bpy.app.handlers.load_post, look_at_file),
    (bpy.app.handlers.undo_post, read_again),
    (bpy.app.handlers.redo_post, read_again),
)


def unregister() -> None:
    for timer in (_go_on, _after_stroke):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    forget()
