# SPDX-License-Identifier: GPL-3.0-or-later
"""A splat object in Edit Mode, for those who read splats: Blender keeps what is edited out of their reach.

Leaving Edit Mode and coming back takes Blender a second for 150,000 splats, draws all of them twice, and is seen. A
copy of the object is made at once, because it shares the arrays.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from ..core.errors import GSkinError
from . import names
from .object_ref import object_by_uid


@contextmanager
def readable(obj: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """The object; in Edit Mode a copy that no scene has, with what is edited as it is now, until the block ends.

    A GSkinError that names the copy leaves the block with the name of the object.
    """
    if obj.mode != "EDIT":
        yield obj
        return
    obj.update_from_editmode()
    name, copy = obj.name, obj.copy()
    copy.data = obj.data.copy()
    copy[names.STANDS_FOR] = obj.data.session_uid
    called, uid, mesh_uid = copy.name, copy.session_uid, copy.data.session_uid
    try:
        yield copy
    except GSkinError as error:
        raise type(error)(error.plain.replace(f"'{called}'", f"'{name}'")) from error
    finally:
        # By session id: another file may be open by now.
        made = object_by_uid(uid, called)
        if made is not None:
            bpy.data.objects.remove(made)
        for mesh in [mesh for mesh in bpy.data.meshes if mesh.session_uid == mesh_uid and not mesh.users]:
            bpy.data.meshes.remove(mesh)


def is_stand_in(obj: bpy.types.Object) -> bool:
    """Whether `obj` is such a copy."""
    return obj.get(names.STANDS_FOR) is not None


def mesh_uid(obj: bpy.types.Object) -> int:
    """Session id of the object's mesh, of a copy that of the mesh which is edited."""
    return int(obj.get(names.STANDS_FOR, obj.data.session_uid))
