# SPDX-License-Identifier: GPL-3.0-or-later
"""An object to come back to after Blender was left alone: it may be renamed, deleted or undone meanwhile."""

from __future__ import annotations

import bpy

from ..core.errors import InputError


class ObjectRef:
    """A mesh object by its session id, with the number of points that it had."""

    def __init__(self, obj: bpy.types.Object) -> None:
        self.uid, self.name = obj.session_uid, obj.name
        self._mesh, self._count = obj.data.session_uid, len(obj.data.vertices)
        self._shown = bool(obj.users_scene)

    def find(self) -> bpy.types.Object:
        """The object.

        Raises InputError: it is gone or in no scene any more, as deleted ones are; it has another mesh or number of
        points; it is in Edit Mode.
        """
        obj = object_by_uid(self.uid, self.name)
        if obj is None or (self._shown and not obj.users_scene):
            raise InputError(
                f"'{self.name}' was deleted while its weights were worked on; nothing was written, start again."
            )
        if obj.data.session_uid != self._mesh or len(obj.data.vertices) != self._count or obj.mode == "EDIT":
            raise InputError(
                f"'{self.name}' was changed while its weights were worked on; nothing was written, start again."
            )
        return obj


def object_by_uid(uid: int, name: str = "") -> bpy.types.Object | None:
    """The object with this session id; looked for first under `name`, which is quick where it still has it."""
    obj: bpy.types.Object | None = bpy.data.objects.get(name)
    if obj is None or obj.session_uid != uid:
        obj = next((other for other in bpy.data.objects if other.session_uid == uid), None)
    return obj
