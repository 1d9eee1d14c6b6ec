# SPDX-License-Identifier: GPL-3.0-or-later
"""The triangles of everything else in the scene: what splats can be hidden behind.

Surfaces are taken as opaque whatever their material says. Hair, volumes, point clouds and Grease Pencil hide nothing.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .helpers import is_helper

SURFACES = {"MESH", "CURVE", "SURFACE", "META", "FONT"}


def read_triangles(depsgraph: bpy.types.Depsgraph, without: Collection[bpy.types.Object]) -> NDArray[np.float32]:
    """Corners (T, 3, 3) in world space of all evaluated surfaces but those of `without`; of instances, too.

    What is hidden in the viewport or off for renders does not count. In one go, because what is evaluated may be gone
    at the next event.
    """
    left_out = {obj.name_full for obj in without}
    found = []
    known: dict[int, NDArray[np.float32]] = {}
    for instance in depsgraph.object_instances:
        obj: Any = instance.object
        parent = instance.parent
        names = {obj.original.name_full, parent.original.name_full if parent is not None else ""}
        if obj.type not in SURFACES or not instance.show_self or obj.hide_render or names & left_out:
            continue
        if is_helper(obj.original):
            continue
        key = obj.data.as_pointer()
        if key not in known:
            known[key] = _local_triangles(obj)
        matrix = np.array(instance.matrix_world, np.float64)
        if len(known[key]):
            found.append((known[key] @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32))
    return np.concatenate(found) if found else np.zeros((0, 3, 3), np.float32)


def _local_triangles(obj: Any) -> NDArray[np.float32]:
    """Corners (T, 3, 3) of an evaluated object in its own space."""
    mesh = obj.to_mesh()
    if mesh is None:
        return np.zeros((0, 3, 3), np.float32)
    try:
        mesh.calc_loop_triangles()
        corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
        mesh.loop_triangles.foreach_get("vertices", corners)
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
    finally:
        obj.to_mesh_clear()
    return points.reshape(-1, 3)[corners].reshape(-1, 3, 3)
