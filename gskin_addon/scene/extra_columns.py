# SPDX-License-Identifier: GPL-3.0-or-later
"""Further columns of a splat file as attributes of a mesh, from which they come back with type and value.

Blender has 32-bit integers and single-precision numbers. What fits is stored as such, for use in Geometry Nodes;
unsigned and 64-bit columns are stored as their bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from . import names
from .attributes import read_attribute, write_attribute

Array = NDArray[Any]


def write_extra(mesh: bpy.types.Mesh, extra: Mapping[str, Array]) -> dict[str, str]:
    """Store columns (N,) of any number type; gives what `read_extra` finds in the mesh's `names.MARK`."""
    for column, values in extra.items():
        kind, stored = _as_attribute(values)
        write_attribute(mesh, names.EXTRA.format(column), kind, stored)
    # Two lists, because older versions read the first one.
    return {"extra": "\n".join(extra), "types": "\n".join(values.dtype.str[1:] for values in extra.values())}


def read_extra(mesh: bpy.types.Mesh) -> dict[str, Array]:
    """The columns of `write_extra` by name, with their number types; those that were removed are left out."""
    mark: Any = mesh[names.MARK]
    columns = [column for column in str(mark.get("extra", "")).split("\n") if column]
    types = str(mark.get("types", "")).split("\n")
    found = {}
    for place, column in enumerate(columns):
        values = read_attribute(mesh, names.EXTRA.format(column))
        if values is not None:
            found[column] = _from_attribute(values, types[place] if place < len(types) else "")
    return found


def _as_attribute(values: Array) -> tuple[str, Array]:
    """Blender's attribute type, and the values or their bits (N,) or (N, 2)."""
    dtype = values.dtype
    if dtype == np.bool_:
        return "BOOLEAN", values
    if dtype.itemsize == 8:
        bits = np.ascontiguousarray(values, dtype=dtype.newbyteorder("<"))
        return "INT32_2D", bits.view("<i4").reshape(-1, 2)
    if dtype.kind == "f":
        return "FLOAT", values
    return "INT", values.astype(np.uint32).view(np.int32) if dtype == np.uint32 else values


def _from_attribute(values: Array, code: str) -> Array:
    """A column of NumPy type `code` ("" where none is known) from what its attribute holds."""
    if not code or values.dtype == np.bool_:
        return values
    dtype = np.dtype(code)
    if values.ndim == 2:
        return np.ascontiguousarray(values, dtype="<i4").view(np.dtype("<" + code)).reshape(-1).astype(dtype)
    if dtype == np.uint32 and values.dtype == np.int32:
        return values.view(np.uint32)
    if dtype.kind in "iu" and values.dtype == np.int32:
        limits = np.iinfo(dtype)
        # Somebody has written other numbers, which the file's type cannot hold.
        fits = values.size == 0 or (values.min() >= limits.min and values.max() <= limits.max)
        return values.astype(dtype) if fits else values
    return values.astype(dtype) if dtype.kind == values.dtype.kind else values
