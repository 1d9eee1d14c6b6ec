# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigged splats from glTF: what our reader has of the splats, joined with what Blender's importer has of the rig.

Blender's importer brings armature, actions, and the points with their weights; it loses rotations, sizes and harmonics.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.splats.gltf_container import read_container
from .armature import deform_bone_names
from .attributes import read_positions
from .bone_frames import armature_modifier
from .rig_files import import_objects
from .splat_object import splat_count
from .transforms import points_in_world
from .weights import read_weights, write_weights

_SAME = 1e-4
"""Distance of a splat to its point over the size of all, up to which they are the same."""


def is_rigged(path: Path) -> bool:
    """Whether a .glb or .gltf file has skins. InputError where it is damaged."""
    return path.suffix.lower() in (".glb", ".gltf") and bool(read_container(path).json.get("skins"))


def bring_rig_of(path: Path, obj: bpy.types.Object, kept: NDArray[np.int64]) -> tuple[bpy.types.Object | None, str]:
    """Let the splats of `obj`, just read from the file and not moved, follow the armature of the file.

    kept (N,): row of each splat among the file's. Gives the armature (None where the file has not one for all splats,
    which then stay at rest), and a clause about it. Raises InputError where Blender cannot import the file.
    """
    added = import_objects(path, skeletons=False)
    armatures = [found for found in added if found.type == "ARMATURE"]
    points = [found for found in added if found.type == "MESH" and len(found.data.vertices) > int(kept.max(initial=0))]
    points = [found for found in points if armature_modifier(found) is not None and _same_places(found, obj, kept)]
    if len(armatures) != 1 or len(points) != 1:
        _remove(added)
        return None, "its skins could not be matched with its splats, which came without a rig"
    armature = armatures[0]
    weights, bones = read_weights(points[0], deform_bone_names(armature))
    _remove([found for found in added if found.type == "MESH"])
    if not (weights > 0).any():
        return None, "its splats have no weights"
    most = int((weights > 0).sum(axis=1).max())
    write_weights(obj, armature, weights[kept], bones, max_influences=max(4, most))
    return armature, f"they follow its armature '{armature.name}'"


def _same_places(mesh: bpy.types.Object, obj: bpy.types.Object, kept: NDArray[np.int64]) -> bool:
    bpy.context.view_layer.update()
    there = points_in_world(read_positions(mesh.data).astype(np.float64), mesh)
    here = read_positions(obj.data).astype(np.float64)
    if splat_count(obj) != len(kept):
        raise InputError(f"'{obj.name}' changed while its file was read; import it again.")
    return float(np.abs(there[kept] - here).max()) <= _SAME * max(float(np.ptp(here, axis=0).max()), 1e-9)


def _remove(objects: list[bpy.types.Object]) -> None:
    for found in objects:
        data: Any = found.data
        bpy.data.objects.remove(found)
        if data is not None and data.users == 0:
            bpy.data.batch_remove([data])
