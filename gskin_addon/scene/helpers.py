# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper objects: what splats need beside themselves, and no artist should meet.

A helper belongs to no collection: Blender evaluates it because a modifier points to it, and saves it with the splats.
Appending and pasting link it to the scene all the same, visible and selected; then it is taken out again.
"""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from . import names

CLASSES = ()

_MARKS = (names.FRAMES_MARK, names.ANCHOR_MARK, names.OCTAHEDRA_MARK, names.PROBE_MARK)


def is_helper(obj: bpy.types.Object) -> bool:
    """Whether `obj` is no object of the artist's but one that splats need."""
    return any(obj.get(mark) is not None for mark in _MARKS)


def hide_helper(helper: bpy.types.Object) -> None:
    """Let `helper` neither show, render nor be picked; what points to it still evaluates it.

    Appending keeps only the flag for renders.
    """
    helper.hide_render = helper.hide_select = helper.hide_viewport = True


@persistent
def put_away(*_: object) -> None:
    """Take helpers that came with an appended figure out of the scene's collections."""
    for obj in bpy.data.objects:
        if obj.library is None and is_helper(obj) and obj.users_collection:
            hide_helper(obj)
            for collection in obj.users_collection:
                collection.objects.unlink(obj)


# Blender 4.2 has no handler of its own for appending.
HANDLERS = ((getattr(bpy.app.handlers, "blend_import_post", bpy.app.handlers.depsgraph_update_post), put_away),)
