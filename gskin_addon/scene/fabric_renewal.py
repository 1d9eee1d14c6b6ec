# SPDX-License-Identifier: GPL-3.0-or-later
"""A new fabric for splats that were joined: in slices from a timer, without a window at once."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from ..core.errors import GSkinError
from .fabric import iter_make_fabric
from .object_ref import object_by_uid
from .steps import Steps, run_for, run_to_end
from .transforms import within_update

CLASSES = ()

BUDGET = 0.04
PAUSE = 0.05
"""Seconds of slices in one call of the timer, and between two calls."""

_wanted: dict[int, Steps[int] | None] = {}
"""By session id of a splat object: the work, None before it begins."""


def renew_later(obj: bpy.types.Object) -> None:
    """Give the splats of `obj` a new fabric as soon as their weights are taken over."""
    _wanted[obj.session_uid] = None
    if not bpy.app.background and not bpy.app.timers.is_registered(_go_on):
        bpy.app.timers.register(_go_on, first_interval=1.0)


@persistent
def follow(*_: object) -> None:
    """Without a window: now, after those that write weights."""
    if not bpy.app.background:
        return
    for uid in [*_wanted]:
        del _wanted[uid]
        obj = object_by_uid(uid)
        if obj is not None and obj.mode == "OBJECT":
            try:
                with within_update():
                    run_to_end(iter_make_fabric(obj))
            except GSkinError as error:
                print(f"gskin: {error}")  # nobody to report to


@persistent
def forget(*_: object) -> None:
    """Another file: session ids mean nothing any more."""
    _wanted.clear()


def _go_on() -> float | None:
    """One call of the timer: seconds until the next, None when all is done."""
    for uid, steps in [*_wanted.items()][:1]:
        obj = object_by_uid(uid)
        if obj is None or obj.mode == "EDIT":
            del _wanted[uid]
            continue
        try:
            if steps is None:
                steps = _wanted[uid] = iter_make_fabric(obj)
            run_for(steps, BUDGET)
        except StopIteration:
            _wanted.pop(uid, None)
        except GSkinError as error:
            _wanted.pop(uid, None)
            print(f"gskin: {error}")
    return PAUSE if _wanted else None


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, follow),
    (bpy.app.handlers.load_post, forget),
)


def unregister() -> None:
    if bpy.app.timers.is_registered(_go_on):
        bpy.app.timers.unregister(_go_on)
    _wanted.clear()
