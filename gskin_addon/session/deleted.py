# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that an artist deletes while the panel names them.

A property that names an object keeps it in the file, and a deleted armature goes on moving its splats. So the panel
lets go of what is in no collection any more, and what nothing else uses is deleted as it would have been without it.
"""

from __future__ import annotations

from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..scene.leftovers import remove_later

CLASSES = ()

NAMES = ("splats", "armature", "proxy")


@persistent
def let_go(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """After any change; looks at three names where objects came or went, at nothing else."""
    if any(isinstance(update.id, bpy.types.Scene) for update in depsgraph.updates):
        let_go_of_deleted()


def let_go_of_deleted() -> None:
    """Clear the panel's names of objects that are in no collection, and remove those without another user."""
    gone = set()
    for scene in bpy.data.scenes:
        settings: Any = getattr(scene, "gskin", None)
        for name in NAMES if settings is not None and scene.library is None else ():
            obj = getattr(settings, name)
            if obj is not None and not obj.users_collection:
                setattr(settings, name, None)
                gone.add(obj)
    for obj in gone:
        if not obj.users and obj.library is None:
            remove_later(obj)


HANDLERS = ((bpy.app.handlers.depsgraph_update_post, let_go),)
