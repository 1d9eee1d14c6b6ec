# SPDX-License-Identifier: GPL-3.0-or-later
"""Landmarks of a body: empties that carry the name of what they mark, parented to the splats."""

from __future__ import annotations

import bpy
import mathutils
import numpy as np
from numpy.typing import NDArray

MARK = "gskin_landmark"
"""Custom property of an empty: which landmark of `core.skeleton.landmarks.NAMES` it is."""


def add_landmark(splats: bpy.types.Object, name: str, place: NDArray[np.float64]) -> bpy.types.Object:
    """Mark a place (3,) in the world as a landmark of a splat object; one that was marked before moves there."""
    found = _empties(splats).get(name)
    if found is None:
        found = bpy.data.objects.new(name, None)
        found[MARK] = name
        found.empty_display_type = "SPHERE"
        found.show_name = found.show_in_front = True
        for collection in splats.users_collection:
            collection.objects.link(found)
        found.parent = splats
    bpy.context.view_layer.update()
    found.empty_display_size = 0.02 * max(*splats.dimensions) / max(splats.matrix_world.median_scale, 1e-9)
    found.location = splats.matrix_world.inverted() @ _vector(place)
    bpy.context.view_layer.update()
    return found


def read_landmarks(splats: bpy.types.Object) -> dict[str, NDArray[np.float64]]:
    """The places (3,) in the world of a splat object's landmarks by their names, as of the last update."""
    return {
        name: np.array(empty.matrix_world.translation, np.float64) for name, empty in _empties(splats).items()
    }


def remove_landmarks(splats: bpy.types.Object) -> int:
    """Take all landmarks of a splat object away; how many."""
    found = list(_empties(splats).values())
    for empty in found:
        bpy.data.objects.remove(empty)
    return len(found)


def _empties(splats: bpy.types.Object) -> dict[str, bpy.types.Object]:
    return {str(child[MARK]): child for child in splats.children if MARK in child.keys()}  # noqa: SIM118


def _vector(place: NDArray[np.float64]) -> mathutils.Vector:
    return mathutils.Vector([float(value) for value in place])
