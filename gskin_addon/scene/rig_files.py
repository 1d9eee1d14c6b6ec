# SPDX-License-Identifier: GPL-3.0-or-later
"""Armatures and rigged splats from files, and .blend files that are written whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..core.errors import GSkinError, InputError
from ..core.files import replaced
from .actions import drop_foreign
from .blend_rigs import append_rig, keep_only
from .dependencies import needed_objects
from .gltf_readable import readable
from .splat_object import is_splat_object
from .vertex_groups import set_mode

ARMATURE_SUFFIXES = (".blend", ".glb", ".gltf", ".fbx")


def empty_scene() -> None:
    """Leave the present file for an empty one; preferences and add-ons stay as they are."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


def import_armature(path: Path, name: str | None = None, notes: list[str] | None = None) -> bpy.types.Object:
    """Add the armature of a .blend, .glb, .gltf or .fbx file to the scene, with its actions and all that moves it.

    `name` chooses among several. `notes` gets sentences about what was left out. Raises InputError: no such file or
    kind, unreadable, no armature, no such name.
    """
    if path.suffix.lower() not in ARMATURE_SUFFIXES:
        raise InputError(f"'{path}' is no armature file; give a {', '.join(ARMATURE_SUFFIXES)} file.")
    if not path.is_file():
        raise InputError(f"'{path}' does not exist; check the path of the armature file.")
    if path.suffix.lower() == ".blend":
        return _append(path, name, notes)
    before, actions = set(bpy.data.objects), set(bpy.data.actions)
    _import(path)
    added = [obj for obj in bpy.data.objects if obj not in before]
    armature = _choose([obj for obj in added if obj.type == "ARMATURE"], "armature", name, path)
    needed = needed_objects(armature)
    doubts = drop_foreign([action for action in bpy.data.actions if action not in actions], needed)
    if notes is not None:
        notes += doubts
    keep_only(needed, added)
    return armature


def import_objects(path: Path, *, skeletons: bool = True) -> list[bpy.types.Object]:
    """All objects of a .glb, .gltf or .fbx file, added to the scene; skeletons: see `gltf_readable.readable`.

    Raises InputError where Blender cannot read it.
    """
    before = set(bpy.data.objects)
    _import(path, skeletons=skeletons)
    return [obj for obj in bpy.data.objects if obj not in before]


def open_blend(path: Path) -> None:
    """Open a .blend without running its scripts, and leave Edit Mode, in which armatures stand at rest.

    Raises InputError where it cannot be read.
    """
    if not path.is_file():
        raise InputError(f"'{path}' does not exist; check the path.")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path.absolute()), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        raise InputError(f"'{path}' cannot be opened as a .blend ({_reason(error)}); {_remedy(error)}.") from error
    for obj in bpy.context.view_layer.objects:
        if obj.mode == "EDIT":
            set_mode(obj, "OBJECT")


def find_splats(path: Path, name: str | None = None) -> bpy.types.Object:
    """The scene's splat object; `name` chooses among several. Raises InputError where there is none."""
    here = [obj for obj in bpy.context.scene.objects if is_splat_object(obj)]
    for scene in [] if here else bpy.data.scenes:
        for obj in scene.objects:
            if is_splat_object(obj):
                raise InputError(
                    f"'{path}' has splats, '{obj.name}', in its scene '{scene.name}' and was saved in "
                    f"'{bpy.context.scene.name}'; save it in the scene of the splats."
                )
    return _choose(here, "splat object", name, path)


def save_blend(path: Path) -> None:
    """Save the present file at `path`, by way of a temporary file. Raises GSkinError where that fails."""
    try:
        with replaced(path, ".blend") as temporary:
            temporary.unlink()  # Blender would keep what is there as a backup, .blend1
            bpy.ops.wm.save_as_mainfile(filepath=str(temporary), check_existing=False, copy=True, compress=True)
    except RuntimeError as error:
        raise GSkinError(f"'{path}' could not be written ({_reason(error)}); check folder and free space.") from error


def _append(path: Path, name: str | None, notes: list[str] | None) -> bpy.types.Object:
    try:
        return append_rig(path, lambda found: _choose(found, "armature", name, path), notes)
    except (OSError, RuntimeError, ValueError) as error:
        if isinstance(error, GSkinError):
            raise
        raise InputError(f"'{path}' cannot be read as a .blend ({_reason(error)}); {_remedy(error)}.") from error


def _import(path: Path, *, skeletons: bool = True) -> None:
    try:
        if path.suffix.lower() == ".fbx":
            # Other programs' bones do not lie along their y axis; this turns them to their children.
            bpy.ops.import_scene.fbx(filepath=str(path.absolute()), automatic_bone_orientation=True)
        else:
            # glTF has no bone tails; this points them at the children and keeps Blender's own bones.
            options: dict[str, Any] = {"bone_heuristic": "TEMPERANCE"}
            gltf: Any = bpy.ops.import_scene.gltf
            if "disable_bone_shape" in gltf.get_rna_type().properties:
                options["disable_bone_shape"] = True
            with readable(path, skeletons=skeletons) as copy:
                bpy.ops.import_scene.gltf(filepath=str(copy.absolute()), **options)
    except (RuntimeError, AttributeError, ValueError, KeyError, TypeError, IndexError, OSError) as error:
        raise InputError(f"'{path}' cannot be imported ({_reason(error)}); export it again.") from error


def _choose(found: list[bpy.types.Object], kind: str, name: str | None, path: Path) -> bpy.types.Object:
    names = ", ".join(f"'{obj.name}'" for obj in found)
    if not found:
        raise InputError(f"'{path}' has no {kind}; choose a file with one.")
    if name is None:
        if len(found) > 1:
            option = "--armature-name" if kind == "armature" else "--object"
            raise InputError(f"'{path}' has several {kind}s; choose one of {names} with {option}.")
        return found[0]
    for obj in found:
        if obj.name == name:
            return obj
    raise InputError(f"'{path}' has no {kind} '{name}'; it has {names}.")


def _remedy(error: BaseException) -> str:
    # Blender 4.4 and older cannot read a single word of what 5.0 writes.
    if "newer version of Blender" in str(error):
        return f"this is Blender {bpy.app.version_string}: export the armature as .glb or .fbx from the newer one"
    return "save it again"


def _reason(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if lines else type(error).__name__).removeprefix("Error: ").rstrip(".")
