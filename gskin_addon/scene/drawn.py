# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats of the evaluated scene as arrays: as the modifiers leave them, the display aside."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import bpy
import numpy as np

from ..core.errors import InputError
from ..core.render.drawn_splats import DrawnSplats
from ..core.rig.quaternion import quat_multiply
from . import names
from .attributes import read_attribute, read_positions
from .deform_stack import measured_splats, not_in_the_viewport
from .node_groups import find_display
from .splat_object import is_splat_object


def rendered_splats(view_layer: bpy.types.ViewLayer) -> list[bpy.types.Object]:
    """The splat objects that a render shows: visible, and not off for renders."""
    return [
        obj
        for obj in view_layer.objects
        if is_splat_object(obj) and not obj.hide_render and obj.visible_get(view_layer=view_layer)
    ]


@contextlib.contextmanager
def bare(objects: Sequence[bpy.types.Object]) -> Iterator[None]:
    """Take the objects' display away for the block, so that what is evaluated are the splats themselves."""
    shown = [modifier for obj in objects if (modifier := find_display(obj)) is not None and modifier.show_viewport]
    for modifier in shown:
        modifier.show_viewport = False
    try:
        yield
    finally:
        for modifier in shown:
            modifier.show_viewport = True


def read_drawn(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> DrawnSplats:
    """The splats of an object of `rendered_splats` as posed; its display must be off (`bare`).

    Raises InputError where it is edited, or a modifier has taken away what splats are made of.
    """
    if obj.mode == "EDIT":
        raise InputError(f"'{obj.name}' is in Edit Mode; leave it (Tab) and try again.")
    mesh: Any = obj.evaluated_get(depsgraph).data
    columns = {name: read_attribute(mesh, name) for name in (names.ROTATION, names.SCALE, names.BASE)}
    for name, values in columns.items():
        if values is None:
            raise InputError(
                f"The modifiers of '{obj.name}' leave no splat attribute '{name}'; turn off the one that removes it."
            )
    rotation, scale, base = columns.values()
    bands: list[Any] = []
    while (band := read_attribute(mesh, names.SH.format(len(bands)))) is not None:
        bands.append(band)
    whole = int(np.sqrt(len(bands) + 1)) ** 2
    sh = np.empty((len(base), whole, 3), np.float32)
    sh[:, 0] = base[:, :3]
    for index in range(whole - 1):
        sh[:, index + 1] = bands[index]
    points, turns = read_positions(mesh), _turns(obj, mesh, rotation) if whole > 1 else None
    matrix = np.array(obj.evaluated_get(depsgraph).matrix_world, np.float64)
    if not_in_the_viewport(obj):
        # The nodes know nothing of what else the modifiers do around a splat. Evaluates anew: what was read is copied.
        points, rotation, scale, turns = measured_splats(obj)
    return DrawnSplats(
        points=points,
        rotations=rotation,
        scales=np.maximum(scale, 0.0),
        opacities=np.clip(base[:, 3], 0.0, 1.0),
        sh=sh,
        turns=turns if whole > 1 else None,
        matrix=matrix,
    )


def _turns(obj: bpy.types.Object, mesh: Any, posed: Any) -> Any:
    """How the bones have turned the splats (N, 4); from before and after where the nodes of an older file keep none."""
    turns = read_attribute(mesh, names.TURN)
    if turns is not None:
        return turns
    rest = read_attribute(obj.data, names.ROTATION)
    if rest is None or len(rest) != len(posed) or np.array_equal(rest, posed):
        return None
    return quat_multiply(posed, rest * np.array([1, -1, -1, -1], np.float32)).astype(np.float32)
