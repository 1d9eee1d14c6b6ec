# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole attributes of the points of a mesh or a point cloud, to and from arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

ObjectData = Any
"""What `Object.data` is, by Blender's typings one of a dozen kinds; here that of a mesh or point cloud object."""

# Blender's attribute type -> (property that holds the value, numbers per element, numpy type of foreach_*).
# FLOAT_COLOR's "color" is the raw linear value; only "color_srgb" would be colour managed.
_LAYOUT: dict[str, tuple[str, int, Any]] = {
    "FLOAT": ("value", 1, np.float32),
    "INT": ("value", 1, np.int32),
    "INT32_2D": ("value", 2, np.int32),
    "BOOLEAN": ("value", 1, np.bool_),
    "FLOAT_VECTOR": ("vector", 3, np.float32),
    "FLOAT_COLOR": ("color", 4, np.float32),
    "QUATERNION": ("value", 4, np.float32),
    "FLOAT4": ("vector", 4, np.float32),  # Blender 5.3 and later; what its own splats have their colours in
}


def write_attribute(mesh: ObjectData, name: str, kind: str, values: NDArray[Any]) -> None:
    """Store `values` (N,) or (N, k) as point attribute `name` of Blender's type `kind`, replacing any other."""
    prop, width, dtype = _LAYOUT[kind]
    attribute = mesh.attributes.get(name)
    if attribute is not None and (attribute.data_type != kind or attribute.domain != "POINT"):
        mesh.attributes.remove(attribute)
        attribute = None
    if attribute is None:
        attribute = mesh.attributes.new(name, kind, "POINT")
    flat = np.ascontiguousarray(values, dtype=dtype).reshape(-1)
    if flat.size != width * len(attribute.data):
        raise ValueError(f"{name} has {flat.size} numbers for {len(attribute.data)} points of width {width}")
    attribute.data.foreach_set(prop, flat)


def read_attribute(mesh: ObjectData, name: str) -> NDArray[Any] | None:
    """Point attribute `name` as (N,) or (N, k); None where the mesh has no such attribute on its points."""
    attribute = mesh.attributes.get(name)
    if attribute is None or attribute.domain != "POINT" or attribute.data_type not in _LAYOUT:
        return None
    prop, width, dtype = _LAYOUT[attribute.data_type]
    flat = np.empty(len(attribute.data) * width, dtype=dtype)
    attribute.data.foreach_get(prop, flat)
    return flat if width == 1 else flat.reshape(-1, width)


def read_flags(mesh: ObjectData, name: str) -> NDArray[np.bool_]:
    """`select` or `hide` (N,) of a mesh's vertices; while it is edited, as they were before."""
    flags = np.zeros(len(mesh.vertices), np.bool_)
    mesh.vertices.foreach_get(name, flags)
    return flags


def read_positions(mesh: ObjectData) -> NDArray[np.float32]:
    """Positions (N, 3) of the vertices or points in the object's own space."""
    places = mesh.attributes["position"].data
    flat = np.empty(len(places) * 3, dtype=np.float32)
    places.foreach_get("vector", flat)
    return flat.reshape(-1, 3)


def write_positions(mesh: ObjectData, points: NDArray[Any]) -> None:
    """Set the vertex positions from (N, 3)."""
    flat = np.ascontiguousarray(points, dtype=np.float32).reshape(-1)
    mesh.attributes["position"].data.foreach_set("vector", flat)
    mesh.update()
