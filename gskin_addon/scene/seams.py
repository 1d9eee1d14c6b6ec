# SPDX-License-Identifier: GPL-3.0-or-later
"""Seams of a splat object: labels of splats on both sides of where parts touch that do not belong together."""

from __future__ import annotations

from typing import Any

import bmesh
import bpy
import numpy as np
from numpy.typing import NDArray

from . import names
from .attributes import ObjectData, read_attribute, write_attribute

Array = NDArray[Any]


def read_seams(obj: bpy.types.Object) -> Array | None:
    """Labels (N,) int64, 0 for none, see `core.skinning.walls`; None where there are no seams."""
    labels = read_attribute(obj.data, names.SIDE)
    return None if labels is None or not labels.any() else labels.astype(np.int64)


def write_seams(obj: bpy.types.Object, labels: Array | None) -> None:
    """Store the labels (N,) with the splats, in Edit Mode with what is edited; None, or zeros alone, for no seams."""
    if obj.mode == "EDIT":
        _write_edited(obj.data, labels)
        return
    if labels is None or not np.any(labels):
        if names.SIDE in obj.data.attributes:
            obj.data.attributes.remove(obj.data.attributes[names.SIDE])
    else:
        write_attribute(obj.data, names.SIDE, "INT", labels)
    obj.data.update()


def _write_edited(mesh: ObjectData, labels: Array | None) -> None:
    work = bmesh.from_edit_mesh(mesh)
    layers = work.verts.layers.int
    layer = layers.get(names.SIDE)
    if labels is None or not np.any(labels):
        if layer is not None:
            layers.remove(layer)
    else:
        known = layer is not None
        layer = layer or layers.new(names.SIDE)
        work.verts.ensure_lookup_table()
        rows = np.arange(len(labels)) if known else np.flatnonzero(labels)  # a new one is 0 everywhere
        for row, label in zip(rows.tolist(), labels[rows].tolist(), strict=True):
            work.verts[row][layer] = label
    bmesh.update_edit_mesh(mesh, loop_triangles=False, destructive=False)
