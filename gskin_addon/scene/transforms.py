# SPDX-License-Identifier: GPL-3.0-or-later
"""An object's place in the world, as far as splats can follow it: rotation, uniform scale, translation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .names import STANDS_FOR
from .visibility import shown

Array = NDArray[Any]

_within_update = False


@contextmanager
def within_update() -> Iterator[None]:
    """Inside the block Blender tells of an update: places are as they should be, and nothing may be evaluated anew."""
    global _within_update
    before, _within_update = _within_update, True
    try:
        yield
    finally:
        _within_update = before


def world_similarity(obj: bpy.types.Object, *, mirrored: bool = False) -> tuple[Array, float, Array]:
    """Rotation (3, 3), scale, translation (3,) in float64 of the object's world matrix.

    mirrored: whether it may mirror; the scale is negative then, since each mirror image is a rotation of the one
    through the origin. Raises InputError where the matrix is not uniform: a stretched, sheared or mirrored Gaussian
    has no rotation and scale of its own.
    """
    if _within_update or obj.get(STANDS_FOR) is not None:
        return similarity_as_shown(obj, mirrored=mirrored)
    with shown([obj]):
        bpy.context.view_layer.update()  # matrix_world lags behind location, rotation and scale set by a script
        return similarity_as_shown(obj, mirrored=mirrored)


def similarity_as_shown(obj: bpy.types.Object, *, mirrored: bool = False) -> tuple[Array, float, Array]:
    """`world_similarity` as of the last update, for panels: while they draw, nothing may be updated."""
    matrix = np.array(obj.matrix_world, dtype=np.float64)
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    # Applying would scale the centres of splats, but not the splats themselves.
    remedy = "apply it (Object > Apply > Scale)" if obj.type == "ARMATURE" else "give all three axes one positive scale"
    if scale == 0.0 or (scale < 0.0 and not mirrored):
        raise InputError(f"'{obj.name}' is mirrored or has zero scale; {remedy} and try again.")
    rotation = linear / scale
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
        sizes = ", ".join(f"{s:.4g}" for s in np.linalg.norm(linear, axis=0))
        raise InputError(f"'{obj.name}' is scaled unevenly ({sizes}); {remedy} and try again.")
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt, scale, matrix[:3, 3]


def points_in_world(points: Array, obj: bpy.types.Object) -> Array:
    """Points (N, 3) of the object's space in the world, as of the last update."""
    matrix = np.array(obj.matrix_world, np.float64)
    return points @ matrix[:3, :3].T + matrix[:3, 3]
