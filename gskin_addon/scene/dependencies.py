# SPDX-License-Identifier: GPL-3.0-or-later
"""What an armature needs so that its bones stand where they stand: the objects that move it, and what moves those."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy


def needed_objects(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """`obj` and all objects that it follows, however indirectly: parents, targets of constraints, drivers, modifiers.

    In the order in which they are found. Objects that bones are only drawn as are not among them (`bone_shapes`).
    """
    found: dict[bpy.types.ID, None] = {obj: None}
    waiting: list[bpy.types.ID] = [obj]
    while waiting:
        for other in _direct(waiting.pop(0)):
            if other not in found:
                found[other] = None
                waiting.append(other)
    return [ident for ident in found if isinstance(ident, bpy.types.Object)]


def bone_shapes(objects: list[bpy.types.Object]) -> set[bpy.types.Object]:
    """The objects that bones of the armatures among `objects` are drawn as."""
    bones = [bone for obj in objects if obj.type == "ARMATURE" and obj.pose is not None for bone in obj.pose.bones]
    return {bone.custom_shape for bone in bones if bone.custom_shape is not None}


def driver_targets(fcurve: Any) -> list[tuple[bpy.types.ID, str]]:
    """What a driver reads: datablock, and path in it or name of the bone."""
    return [
        (target.id, target.bone_target or target.data_path)
        for variable in fcurve.driver.variables
        for target in variable.targets
        if target.id is not None
    ]


def unheard_drivers(objects: list[bpy.types.Object]) -> list[str]:
    """Drivers of these objects that are Python which no file may run here, as "'object': path"."""
    if bpy.context.preferences.filepaths.use_scripts_auto_execute:
        return []
    return [
        f"'{obj.name}': {fcurve.data_path}"
        for obj in objects
        for ident in _own(obj)
        for fcurve in _drivers(ident)
        if fcurve.driver.type == "SCRIPTED" and not fcurve.driver.is_simple_expression and not fcurve.mute
    ]


def is_animated(objects: list[bpy.types.Object]) -> bool:
    """Whether any of these objects, or its data, has an action, NLA tracks or drivers."""
    for obj in objects:
        for ident in _own(obj):
            data: Any = getattr(ident, "animation_data", None)
            if data is not None and (data.action is not None or len(data.nla_tracks) or len(data.drivers)):
                return True
    return False


def pointed_objects(struct: Any) -> Iterator[bpy.types.Object]:
    """Objects that a constraint or modifier names, also in its list of targets and in its custom properties."""
    for prop in struct.bl_rna.properties:
        if prop.type == "POINTER" and prop.identifier not in {"rna_type", "active_target"}:
            value = getattr(struct, prop.identifier)
            if isinstance(value, bpy.types.Object):
                yield value
    for target in getattr(struct, "targets", None) or ():
        if isinstance(getattr(target, "target", None), bpy.types.Object):
            yield target.target
    yield from _in_custom_properties(struct)


def _direct(ident: bpy.types.ID) -> Iterator[bpy.types.ID]:
    for fcurve in _drivers(ident):
        yield from (target for target, _ in driver_targets(fcurve) if not isinstance(target, bpy.types.Scene))
    keys = getattr(ident, "shape_keys", None)
    if keys is not None:
        yield keys
    if isinstance(ident, bpy.types.Curve):
        yield from (obj for obj in (ident.bevel_object, ident.taper_object) if obj is not None)
    if not isinstance(ident, bpy.types.Object):
        return
    if ident.parent is not None:
        yield ident.parent
    if ident.data is not None:
        yield ident.data
    yield from _in_custom_properties(ident)
    for struct in [*ident.constraints, *ident.modifiers]:
        yield from pointed_objects(struct)
    if ident.type == "ARMATURE" and ident.pose is not None:
        for bone in ident.pose.bones:
            yield from _in_custom_properties(bone)
            for constraint in bone.constraints:
                yield from pointed_objects(constraint)


def _own(obj: bpy.types.Object) -> list[Any]:
    data: Any = obj.data
    return [ident for ident in (obj, data, getattr(data, "shape_keys", None)) if ident is not None]


def _drivers(ident: Any) -> list[Any]:
    data = getattr(ident, "animation_data", None)
    return [] if data is None else list(data.drivers)


def _in_custom_properties(struct: Any) -> Iterator[bpy.types.Object]:
    if not hasattr(struct, "keys"):
        return
    try:
        values = list(struct.values())
    except TypeError:  # this kind of thing has no custom properties
        return
    yield from (value for value in values if isinstance(value, bpy.types.Object))
