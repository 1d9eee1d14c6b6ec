# SPDX-License-Identifier: GPL-3.0-or-later
"""After a change of the display's settings or of the splats: as many octahedra as splats are seen (see `octahedra.py`).

Without this the splats would be drawn right, but slowly.
"""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from .display_inputs import OCTAHEDRA
from .node_builder import get_input, has_input
from .node_groups import find_display, match_octahedra
from .splat_object import is_splat_object

CLASSES = ()

_known: dict[int, tuple[object, ...]] = {}
"""By session id of a splat object: what its number of octahedra was last made from."""


@persistent
def follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Look at the splat objects of the last change; microseconds for each unless its settings changed."""
    for update in depsgraph.updates:
        obj = update.id.original if isinstance(update.id, bpy.types.Object) else None
        if obj is None or not update.is_updated_geometry or not is_splat_object(obj) or obj.mode == "EDIT":
            continue
        modifier = find_display(obj)
        if modifier is None or not has_input(modifier, OCTAHEDRA) or obj.library is not None:
            continue
        helper = get_input(modifier, OCTAHEDRA)
        settings = (get_input(modifier, "Viewport Limit"), get_input(modifier, "Minimum Opacity"))
        made_from = (len(obj.data.vertices), *settings, helper.name if helper else "")
        if _known.get(obj.session_uid) == made_from:
            continue
        match_octahedra(obj)
        helper = get_input(modifier, OCTAHEDRA)
        _known[obj.session_uid] = (*made_from[:3], helper.name if helper else "")


@persistent
def forget(*_: object) -> None:
    """Another file: session ids mean nothing any more."""
    _known.clear()


HANDLERS = ((bpy.app.handlers.depsgraph_update_post, follow), (bpy.app.handlers.load_post, forget))
