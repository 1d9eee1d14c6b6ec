# SPDX-License-Identifier: GPL-3.0-or-later
"""Skeletons from files into the scene, and into splats."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import bpy

from ..core.errors import InputError
from ..core.skeleton.placing import Placing, guess_placing
from ..core.skeleton.read import READERS, read_skeleton_file
from .fitted_rig import create_armature
from .rig_files import ARMATURE_SUFFIXES, import_armature
from .rig_fit import place_rig, rest_skeleton, sample_splats, to_world

SUFFIXES = (*READERS, *ARMATURE_SUFFIXES, ".vrm")


def import_skeleton(path: Path, splats: bpy.types.Object | None) -> tuple[bpy.types.Object, Placing | None]:
    """The armature of a file, added to the scene; with splats it is brought into them, and how is told as well.

    What one of `core.skeleton.read.READERS` reads becomes new bones; of other files Blender's importers make the
    armature, and the object, or what carries it, is turned, scaled and moved; an empty carries it where it is animated
    as an object. A .vrm is a .glb.

    Raises:
        InputError: no such file or kind, unreadable, no skeleton.
    """
    if not path.is_file():
        raise InputError(f"'{path}' does not exist; check the path of the skeleton file.")
    bpy.context.view_layer.update()
    points = None if splats is None else to_world(sample_splats(splats).points, splats)
    suffix = path.suffix.lower()
    if suffix in READERS:
        skeleton = read_skeleton_file(path)
        placing = None if points is None else guess_placing(skeleton, points)
        if placing is not None:
            skeleton = placing.of(skeleton)
        return create_armature(skeleton, path.stem), placing
    if suffix not in SUFFIXES:
        raise InputError(f"'{path}' is no skeleton file; give a {', '.join(SUFFIXES)} file.")
    armature = _import_vrm(path) if suffix == ".vrm" else import_armature(path)
    bpy.context.view_layer.update()
    if points is None:
        return armature, None
    bones = rest_skeleton(armature)
    if not bones.count:
        raise InputError(f"The armature of '{path}' has no deform bones; turn on Deform for those that move the body.")
    placing = guess_placing(bones, points)
    if placing.plain:
        place_rig(armature, placing.rotation, placing.scale, placing.translation)
    return armature, placing


def _import_vrm(path: Path) -> bpy.types.Object:
    """A VRM avatar is a .glb under another name; Blender's importer goes by the name."""
    with tempfile.TemporaryDirectory(prefix="gskin-vrm-") as folder:
        copy = Path(folder) / f"{path.stem}.glb"
        shutil.copyfile(path, copy)
        try:
            return import_armature(copy)
        except InputError as error:
            raise InputError(str(error).replace(str(copy), str(path))) from error
