# SPDX-License-Identifier: GPL-3.0-or-later
"""Octahedra: a helper mesh of so many separate octahedra, of which the viewport's display borrows faces and edges.

Making half a million faces anew costs more than posing the splats, and only their corners' positions and colours
change with the pose. An Array modifier makes the faces once: the helper depends on nothing, so Blender keeps them
until the file is closed, and saves only the one octahedron that they are made of. Helpers are never changed: another
number is another helper.
"""

from __future__ import annotations

from typing import Any

import bpy

from . import names
from .helpers import hide_helper
from .materials import viewport_material

CORNERS = 6


def ensure_octahedra(count: int) -> bpy.types.Object:
    """The helper of `count` octahedra; made where there is none."""
    for obj in bpy.data.objects:
        if octahedra_count(obj) == count and obj.library is None:
            return obj
    helper = bpy.data.objects.new("GSkin Octahedra", octahedron())
    helper[names.OCTAHEDRA_MARK] = True
    array: Any = helper.modifiers.new("Array", "ARRAY")
    array.count, array.use_relative_offset = count, False
    # Taken out of a scene by `helpers.py`; where the add-on is not there to do so, at least it has no size.
    helper.scale = (0.0, 0.0, 0.0)
    hide_helper(helper)
    return helper


def octahedra_count(obj: bpy.types.Object | None) -> int:
    """How many octahedra a helper has; 0 for any other object."""
    if obj is None or obj.get(names.OCTAHEDRA_MARK) is None or not obj.modifiers:
        return 0
    array: Any = obj.modifiers[0]
    return int(array.count)


def octahedron() -> bpy.types.Mesh:
    """The shared mesh of one octahedron, corners +x -x +y -y +z -z.

    A primitive node would do but for the colours: Solid mode shows the *active* colour attribute, nodes cannot choose
    it, and Realize Instances takes the choice from the instanced mesh.
    """
    for mesh in bpy.data.meshes:
        if mesh.get(names.OCTAHEDRON_MARK) is not None and mesh.library is None:
            if [*mesh.materials] != [viewport_material()]:  # that of an older file is opaque
                mesh.materials.clear()
                mesh.materials.append(viewport_material())
            return mesh
    mesh = bpy.data.meshes.new("GSkin Octahedron")
    mesh[names.OCTAHEDRON_MARK] = True
    corners = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    mesh.from_pydata(corners, [], faces)
    mesh.materials.append(viewport_material())
    mesh.color_attributes.active_color_name = names.COLOR
    return mesh
