# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that are scaled unevenly or mirrored, which splats cannot follow, and how they become even."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..core.errors import InputError
from .placement import refuse_bound
from .splat_object import is_splat_object
from .transforms import similarity_as_shown, world_similarity


def has_even_scale(obj: bpy.types.Object) -> bool:
    """Whether the object has one positive scale for all axes in the world, as of the last update."""
    try:
        similarity_as_shown(obj)
    except InputError:
        return False
    return True


def even_scale(obj: bpy.types.Object) -> None:
    """Splats get the mean of their three scales, all positive; an armature's bones take its scale over.

    Raises InputError: the uneven scale is a parent's, splats follow something, the armature is shared or linked.
    """
    if is_splat_object(obj):
        refuse_bound(obj)
        mean = float(np.cbrt(np.abs(np.array(obj.scale)).prod()))
        obj.scale = (mean or 1.0,) * 3
    else:
        data: Any = obj.data
        if data.users > 1 or data.library is not None:
            raise InputError(f"The bones of '{obj.name}' are shared or linked; make them single-user and try again.")
        data.transform(Matrix.LocRotScale(None, None, obj.scale))
        obj.scale = (1.0, 1.0, 1.0)
    world_similarity(obj)
