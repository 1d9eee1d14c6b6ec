# SPDX-License-Identifier: GPL-3.0-or-later
"""Armatures out of .blend files, with all that moves them: also linked ones, overrides and instanced collections."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import bpy
import mathutils

from ..core.errors import InputError
from .actions import drop_foreign
from .dependencies import bone_shapes, needed_objects
from .frames import frame_of, go_to
from .helpers import is_helper

_DRAWN = {"MESH", "CURVE", "SURFACE", "META", "FONT"}
"""Kinds of objects that would be seen beside the splats."""

Choose = Callable[[list[bpy.types.Object]], bpy.types.Object]


def append_rig(path: Path, choose: Choose, notes: list[str] | None = None) -> bpy.types.Object:
    """Append the armature that `choose` takes from those of a .blend file, and what moves it; nothing else stays.

    `notes` gets sentences about actions that are left out because they may be another armature's as well.

    All of it is local afterwards and in the scene, which gets the file's frame, frame range and rate. Raises OSError,
    RuntimeError or ValueError where the file cannot be read, InputError as `choose` does and where a library is
    missing.
    """
    before = set(bpy.data.objects)
    libraries: Any = bpy.data.libraries
    with libraries.load(str(path.absolute()), link=False) as (source, target):
        target.objects = list(source.objects)
        target.actions = list(source.actions)
        target.scenes = list(source.scenes)
    scenes = [scene for scene in target.scenes if scene is not None]
    for scene in scenes:
        for layer in scene.view_layers:
            layer.update()
    found = [obj for obj in target.objects if obj is not None]
    armature, instance = _armature_in(found, scenes, path, choose)
    hidden = _hidden(armature if instance is None else instance, scenes)
    armature = make_local(armature)
    needed = needed_objects(armature)
    if instance is not None:
        _realize(instance, needed)
        needed = needed_objects(armature)
    _take_over_scene(armature if instance is None else instance, scenes)
    doubts = drop_foreign([action for action in target.actions if action is not None], needed)
    if notes is not None:
        notes += doubts
    for action in bpy.data.actions:
        action.use_fake_user = True
    keep_only(needed, [obj for obj in bpy.data.objects if obj not in before])
    for obj in needed:
        if obj.name in hidden and obj != armature:
            obj.hide_set(True)
    return armature


def keep_only(needed: list[bpy.types.Object], added: Iterable[bpy.types.Object]) -> None:
    """Link the needed objects to the scene and remove the others of `added`, but not what bones are drawn as."""
    collection = bpy.context.scene.collection
    present = set(bpy.context.scene.objects)
    kept = {*needed, *bone_shapes(needed)}
    for obj in needed:
        if obj not in present:
            collection.objects.link(obj)
        if obj.type in _DRAWN:
            obj.display_type, obj.hide_render = "WIRE", True
    for obj in added:
        if obj not in kept and not is_helper(obj):
            bpy.data.objects.remove(obj)
    data: Any = bpy.data
    data.orphans_purge(do_local_ids=True, do_linked_ids=True, do_recursive=True)
    bpy.context.view_layer.update()


def own_rig(armature: bpy.types.Object) -> bpy.types.Object:
    """`make_local` for an armature of the scene; what is new is linked to the scene."""
    armature = make_local(armature)
    present = set(bpy.context.scene.objects)
    for obj in needed_objects(armature):
        if obj not in present:
            bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.update()
    return armature


def check_whole(armature: bpy.types.Object) -> None:
    """Raises InputError where the armature, or something that moves it, is linked from a file that is missing.

    Blender puts empty objects at the origin in the place of what it does not find.
    """
    for ident in _idents(armature):
        _check_there(ident)


def make_local(armature: bpy.types.Object) -> bpy.types.Object:
    """Make an armature and all that moves it the file's own, no matter whether it was linked or overridden.

    Gives the local armature. Raises InputError where a library is missing.
    """
    copies: dict[Any, Any] = {}
    armature = _local(armature, copies)
    while True:
        foreign = next((ident for ident in _idents(armature) if _is_foreign(ident)), None)
        if foreign is None:
            return armature
        _local(foreign, copies)


def _local(ident: Any, copies: dict[Any, Any]) -> Any:
    """The local version of a datablock, which all local users get; one for each, however often it is met."""
    if not _is_foreign(ident):
        return ident
    _check_there(ident)
    local = copies.get(ident)
    if local is None:
        # What only linked data uses stays linked: then a copy is needed.
        local = ident.make_local(clear_liboverride=True)
        if local is None or _is_foreign(local):
            local = ident.copy()
    if local is None or _is_foreign(local):
        raise InputError(f"'{ident.name}' is linked and cannot be made local; do it in Blender (Object > Relations).")
    if local != ident:
        copies[ident] = local
        ident.user_remap(local)
    return local


def _check_there(ident: Any) -> None:
    if getattr(ident, "is_missing", False):
        path = ident.library.filepath if ident.library is not None else "?"
        raise InputError(f"'{ident.name}' is linked from '{path}', which is missing; put that file back.")


def _is_foreign(ident: Any) -> bool:
    return ident.library is not None or ident.override_library is not None


def _idents(armature: bpy.types.Object) -> list[Any]:
    """The needed objects, what bones are drawn as, their data and their actions."""
    needed = needed_objects(armature)
    objects = [*needed, *bone_shapes(needed)]
    idents: list[Any] = [*objects, *(obj.data for obj in objects if obj.data is not None)]
    for ident in [*idents]:
        data = getattr(ident, "animation_data", None)
        if data is not None:
            strips = [strip for track in data.nla_tracks for strip in track.strips]
            idents += [action for action in [data.action, *(s.action for s in strips)] if action is not None]
    return list(dict.fromkeys(idents))


def _armature_in(
    objects: list[bpy.types.Object], scenes: list[bpy.types.Scene], path: Path, choose: Choose
) -> tuple[bpy.types.Object, bpy.types.Object | None]:
    """The chosen armature, and the instance of a collection that it is in where no scene of the file has one itself.

    In no scene at all it may still lie in the file.
    """
    seen = [obj for scene in scenes for obj in scene.objects]
    placed = [obj for obj in seen if obj.type == "ARMATURE"]
    places: dict[bpy.types.Object, list[bpy.types.Object]] = {}
    for obj in seen or objects:
        if obj.instance_type == "COLLECTION" and obj.instance_collection is not None:
            for inner in obj.instance_collection.all_objects:
                if inner.type == "ARMATURE" and inner not in placed:
                    places.setdefault(inner, []).append(obj)
    loose = [obj for obj in objects if obj.type == "ARMATURE" and obj not in placed and obj not in places]
    direct = placed or ([] if places else loose)
    if direct:
        return choose(list(dict.fromkeys(direct))), None
    missing = [library.filepath for library in bpy.data.libraries if library.is_missing] if not places else []
    if missing:
        files = ", ".join(f"'{name}'" for name in missing)
        raise InputError(f"'{path}' has no armature of its own, and what it links is missing: {files}; put it back.")
    armature = choose(list(places))
    if len(places[armature]) > 1:
        names = ", ".join(f"'{obj.name}'" for obj in places[armature])
        raise InputError(f"'{path}' has '{armature.name}' in several instances, {names}; make the one you mean real.")
    return armature, places[armature][0]


def _realize(instance: bpy.types.Object, needed: list[bpy.types.Object]) -> None:
    """Put what stood in an instanced collection where the instance stands: the instance becomes its parent."""
    offset = mathutils.Matrix.Translation(instance.instance_collection.instance_offset)
    for obj in needed:
        if obj.parent is None and obj != instance:
            basis = obj.matrix_basis.copy()
            obj.parent, obj.matrix_parent_inverse = instance, offset.inverted()
            obj.matrix_basis = basis
    instance.instance_type = "NONE"
    instance.instance_collection = None


def _hidden(obj: bpy.types.Object, scenes: list[bpy.types.Scene]) -> set[str]:
    """Names of the objects that are not seen in the scene of `obj`."""
    scene = next((scene for scene in scenes if scene.objects.get(obj.name) == obj), None)
    if scene is None:
        return set()
    return {other.name for other in scene.objects if not other.visible_get(view_layer=scene.view_layers[0])}


def _take_over_scene(obj: bpy.types.Object, scenes: list[bpy.types.Scene]) -> None:
    """Frame, range, rate, time stretching and custom properties of the scene that `obj` was in; drivers that read it
    read ours now."""
    here: Any = bpy.context.scene
    if not scenes:
        return
    there: Any = next((scene for scene in scenes if scene.objects.get(obj.name) == obj), scenes[0])
    here.render.fps, here.render.fps_base = there.render.fps, there.render.fps_base
    here.render.frame_map_old, here.render.frame_map_new = there.render.frame_map_old, there.render.frame_map_new
    here.frame_start, here.frame_end = there.frame_start, there.frame_end
    for name, value in there.items():
        if name not in here and isinstance(value, (bool, int, float, str)):
            here[name] = value
    frame = frame_of(there)
    for scene in scenes:
        scene.user_remap(here)
        bpy.data.scenes.remove(scene)
    go_to(here, frame)
