# SPDX-License-Identifier: GPL-3.0-or-later
"""Skeletons from files into the scene, and into splats."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import bpy
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.skeleton import Skeleton
from ..core.skeleton.placing import Placing, guess_placing
from ..core.skeleton.read import READERS, read_skeleton_file
from .fitted_rig import create_armature
from .object_ref import object_by_uid
from .rig_files import ARMATURE_SUFFIXES, import_armature
from .rig_fit import place_rig, rest_skeleton, sample_splats
from .steps import Steps, in_thread, part_of, run_to_end
from .transforms import points_in_world

SUFFIXES = (*READERS, *ARMATURE_SUFFIXES, ".vrm")


def import_skeleton(path: Path, splats: bpy.types.Object | None) -> tuple[bpy.types.Object, Placing | None]:
    """`iter_import_skeleton` at once."""
    return run_to_end(iter_import_skeleton(path, splats))


def iter_import_skeleton(
    path: Path, splats: bpy.types.Object | None
) -> Steps[tuple[bpy.types.Object, Placing | None]]:
    """The armature of a file, added to the scene; with splats it is brought into them, and how is told as well.

    What one of `core.skeleton.read.READERS` reads becomes new bones; of other files Blender's importers make the
    armature, and the object, or what carries it, is turned, scaled and moved; an empty carries it where it is animated
    as an object. A .vrm is a .glb. In slices, but that Blender's importers take theirs as long as they need; closed
    before the end, it takes away what it has added.

    Raises:
        InputError: no such file or kind, unreadable, no skeleton, or it was deleted meanwhile.
    """
    if not path.is_file():
        raise InputError(f"'{path}' does not exist; check the path of the skeleton file.")
    yield 0.0  # the file browser has closed, which is drawn first
    bpy.context.view_layer.update()
    points = None if splats is None else points_in_world(sample_splats(splats).points, splats)
    yield 0.2
    suffix = path.suffix.lower()
    if suffix in READERS:
        skeleton, placing = yield from part_of(in_thread(lambda: _read(path, points)), 0.3, 1.0)
        return create_armature(skeleton, path.stem), placing
    if suffix not in SUFFIXES:
        raise InputError(f"'{path}' is no skeleton file; give a {', '.join(SUFFIXES)} file.")
    known = _ids()
    armature = _import_vrm(path) if suffix == ".vrm" else import_armature(path)
    added = _ids() - known
    uid, name = armature.session_uid, armature.name
    try:
        bpy.context.view_layer.update()
        if points is None:
            return armature, None
        bones = rest_skeleton(armature)
        if not bones.count:
            raise InputError(
                f"The armature of '{path}' has no deform bones; turn on Deform for those that move the body."
            )
        placing = yield from part_of(in_thread(lambda: guess_placing(bones, points)), 0.6, 1.0)
    except GeneratorExit:
        bpy.data.batch_remove([block for block in bpy.data.user_map() if block.session_uid in added])
        raise
    found = object_by_uid(uid, name)
    if found is None:
        raise InputError(f"'{name}' was deleted while its place was looked for; import it again.")
    if placing.plain:
        place_rig(found, placing.rotation, placing.scale, placing.translation)
    return found, placing


def _read(path: Path, points: NDArray[Any] | None) -> tuple[Skeleton, Placing | None]:
    """The skeleton of a file that `READERS` read, in the splats at points (n, 3)."""
    skeleton = read_skeleton_file(path)
    if points is None:
        return skeleton, None
    placing = guess_placing(skeleton, points)
    return placing.of(skeleton), placing


def _ids() -> set[int]:
    """The session ids of all data in the file."""
    return {block.session_uid for block in bpy.data.user_map()}


def _import_vrm(path: Path) -> bpy.types.Object:
    """A VRM avatar is a .glb under another name; Blender's importer goes by the name."""
    with tempfile.TemporaryDirectory(prefix="gskin-vrm-") as folder:
        copy = Path(folder) / f"{path.stem}.glb"
        shutil.copyfile(path, copy)
        try:
            return import_armature(copy)
        except InputError as error:
            raise InputError(str(error).replace(str(copy), str(path))) from error
