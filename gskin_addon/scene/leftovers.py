# SPDX-License-Identifier: GPL-3.0-or-later
"""What nobody needs any more is taken away: objects that an artist has deleted, and what turned splats by an armature
that is gone.

While Blender tells of an update nothing may be removed, since others are still to read what it lists. So it is done in
a timer, and without a window, where no timers run, when all others have been told.
"""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from . import names
from .armature import deform_bone_names
from .attributes import ObjectData
from .bone_frames import armature_of, bone_order, is_bone_frames, is_outdated
from .node_builder import has_input, set_input
from .object_ref import object_by_uid
from .probe_nodes import PROBES
from .probes import is_probe, probes_of
from .rotation_nodes import FRAMES_INPUT, find_rotation, frames_of
from .splat_object import is_splat_object

CLASSES = ()

_wanted = False
_deleted: set[int] = set()


def clean_later() -> None:
    """Have `clean` called as soon as it may be."""
    global _wanted
    _wanted = True
    if not bpy.app.background and not bpy.app.timers.is_registered(_clean_now):
        bpy.app.timers.register(_clean_now, first_interval=0.0)


def remove_later(obj: bpy.types.Object) -> None:
    """Remove an object that is in no collection as soon as that may be, if nothing uses it then."""
    _deleted.add(obj.session_uid)
    clean_later()


def clean() -> None:
    """Remove what is wanted gone, rotation nodes of splats without an armature, bone frames and probes of nobody."""
    global _wanted
    _wanted = False
    for uid in [*_deleted]:
        obj = object_by_uid(uid)
        if obj is not None and not obj.users and not obj.users_collection and obj.library is None:
            bpy.data.objects.remove(obj)
    _deleted.clear()
    for obj in bpy.data.objects:
        if is_splat_object(obj) and obj.library is None and armature_of(obj) is None:
            rotation = find_rotation(obj)
            if rotation is not None:
                # Blender 5.2 goes on counting a user of what a removed modifier named.
                for label in (FRAMES_INPUT, *PROBES):
                    if has_input(rotation, label):
                        set_input(rotation, label, None)
                obj.modifiers.remove(rotation)
    used = {frames_of(obj) for obj in bpy.data.objects if is_splat_object(obj)}
    for frames in [obj for obj in bpy.data.objects if is_bone_frames(obj) and obj.library is None]:
        if frames not in used and not fits(frames, armature_of(frames)):
            mesh: ObjectData = frames.data
            bpy.data.objects.remove(frames)
            if mesh is not None and not mesh.users:
                bpy.data.meshes.remove(mesh)
    _clean_probes()


def _clean_probes() -> None:
    used = {probe for obj in bpy.data.objects if is_splat_object(obj) for probe in probes_of(obj)}
    for probe in [obj for obj in bpy.data.objects if is_probe(obj) and obj.library is None and obj not in used]:
        bpy.data.objects.remove(probe)
    for mesh in [mesh for mesh in bpy.data.meshes if mesh.get(names.PROBE_MARK) is not None and not mesh.users]:
        bpy.data.meshes.remove(mesh)


def fits(frames: bpy.types.Object, rig: bpy.types.Object | None) -> bool:
    """Whether bone frames are made for the bones that an armature has now."""
    if rig is None or not any(bone.use_deform for bone in rig.data.bones):
        return False
    return bone_order(frames) == deform_bone_names(rig) and not is_outdated(frames, rig)


@persistent
def follow(*_: object) -> None:
    """After all others; nothing where nothing is wanted."""
    if _wanted and bpy.app.background:
        clean()


def _clean_now() -> None:
    if _wanted:
        clean()


HANDLERS = ((bpy.app.handlers.depsgraph_update_post, follow),)


def unregister() -> None:
    if bpy.app.timers.is_registered(_clean_now):
        bpy.app.timers.unregister(_clean_now)
    _deleted.clear()
