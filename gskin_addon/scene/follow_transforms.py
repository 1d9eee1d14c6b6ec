# SPDX-License-Identifier: GPL-3.0-or-later
"""After Apply Rotation or Scale (Ctrl-A): let rotations, scales and spherical harmonics follow the positions.

Blender applies an object's transform to the positions of a mesh alone. Every splat mesh therefore keeps where a few
of its splats were when all its attributes fitted together; when they are found elsewhere, the similarity between
says how the other attributes must change. The places are stored in the mesh itself, so undo, redo and files restore
them along with the attributes: whatever state comes back, its places tell whether it is still to be corrected.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ..core.errors import GSkinError
from ..core.splats.axes import rotate_cloud
from ..core.splats.similarity import fit_similarity, is_affine
from . import names
from .anchor_nodes import find_anchor
from .splat_object import is_splat_object, read_cloud, reference_points, remember_places, replace_cloud

CLASSES = ()

_busy = False


def follow_transform(obj: bpy.types.Object) -> bool:
    """Correct the splats of `obj` where its positions were turned or scaled as a whole; True if it was needed.

    Uneven scale and mirroring, which no splat can follow, and anchored splats are left as they are with a warning
    in the mesh (`warning_of`). Any other change of positions is the artist's.
    """
    mesh: Any = obj.data
    if obj.mode == "EDIT":
        return False
    stored = reference_points(mesh)
    if stored is None:
        remember_places(mesh)
        return False
    before, now = stored
    if np.array_equal(before, now):
        return False
    found = fit_similarity(before, now)
    if found is None:
        if is_affine(before, now):
            _warn(mesh, "Scaled unevenly or mirrored: splats cannot follow; undo, and give all axes one positive scale")
        remember_places(mesh)
        return False
    if not found.turns_or_scales:
        remember_places(mesh)
        return False
    if find_anchor(obj) is not None:
        _warn(mesh, "Turned or scaled after anchoring; anchor the splats again")
    cloud = read_cloud(obj, world=False)
    turned = rotate_cloud(cloud, found.rotation)
    replace_cloud(obj, replace(turned, means=cloud.means, scales=turned.scales * np.float32(found.scale)))
    return True


def warning_of(obj: bpy.types.Object) -> str:
    """What an applied transform has broken, in a sentence; empty where all is well."""
    return str(obj.data[names.MARK].get("warning", ""))


def _warn(mesh: bpy.types.Mesh, sentence: str) -> None:
    mesh[names.MARK]["warning"] = sentence


@persistent
def follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Look at the objects of the last change; a few microseconds for each splat object among them."""
    _correct([u.id.original for u in depsgraph.updates if isinstance(u.id, bpy.types.Object)])


@persistent
def follow_all(*_: object) -> None:
    """Another state of the file: by undo, redo or loading."""
    _correct(list(bpy.data.objects))


def _correct(objects: list[bpy.types.Object]) -> None:
    global _busy
    if _busy:
        return
    _busy = True
    try:
        for obj in objects:
            if is_splat_object(obj) and obj.library is None and obj.data.library is None:
                try:
                    follow_transform(obj)
                except GSkinError as error:
                    print(f"gskin: {error}")  # nobody to report to; the operators say the same to whoever asks
    finally:
        _busy = False


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, follow),
    (bpy.app.handlers.undo_post, follow_all),
    (bpy.app.handlers.redo_post, follow_all),
    (bpy.app.handlers.load_post, follow_all),
)
