# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats as a Blender object: a mesh of loose vertices, one per splat, with the splat's values as attributes.

A mesh and not a point cloud, because only meshes take vertex groups and an Armature modifier. Attribute names are
those of Blender 5.3's native splats, so that Mesh to Points will give a native cloud.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.quaternion import normalize
from ..core.splats.axes import rotate_cloud
from ..core.splats.cloud import SplatCloud
from . import names
from .attributes import ObjectData, read_attribute, read_positions, write_attribute, write_positions
from .extra_columns import read_extra, write_extra
from .node_groups import add_display, display_steps
from .steps import Steps, part_of, run_to_end
from .transforms import world_similarity

VERSION = 1

_PLACES = 64
"""Splats whose places tell whether the positions were turned or scaled without the other attributes."""


def create_splat_object(
    cloud: SplatCloud, name: str, *, collection: bpy.types.Collection | None = None, display: bool = True
) -> bpy.types.Object:
    """A new mesh object that holds `cloud` in Blender's world axes, linked to `collection` (default: the scene's).

    With `display` it gets the node group that draws the splats. Takes 0.3 s per million splats of degree 0.
    Raises InputError for an empty cloud.
    """
    return run_to_end(create_splat_steps(cloud, name, collection=collection, display=display))


def create_splat_steps(
    cloud: SplatCloud, name: str, *, collection: bpy.types.Collection | None = None, display: bool = True
) -> Steps[bpy.types.Object]:
    """`create_splat_object` in slices; nothing of it stays where they end early."""
    if cloud.count == 0:
        raise InputError(f"'{name}' has no splats; choose a file with at least one.")
    mesh = bpy.data.meshes.new(name)
    try:
        mesh.vertices.add(cloud.count)
        yield 0.0
        yield from part_of(_column_steps(mesh, cloud), 0.0, 0.9)
        if display:
            yield from part_of(display_steps(), 0.9, 1.0)
    except BaseException:
        bpy.data.meshes.remove(mesh)
        raise
    obj = bpy.data.objects.new(name, mesh)
    (collection or bpy.context.scene.collection).objects.link(obj)
    if cloud.offset.any():
        obj[names.GEO_OFFSET] = cloud.offset.tolist()
    if display:
        add_display(obj)
    return obj


def is_splat_object(obj: bpy.types.Object | None) -> bool:
    """Whether `obj` is a mesh that gskin made from splats."""
    return obj is not None and obj.type == "MESH" and obj.data.get(names.MARK) is not None


def splat_count(obj: bpy.types.Object) -> int:
    """Number of splats of a splat object."""
    return len(obj.data.vertices)


def read_cloud(obj: bpy.types.Object, *, world: bool = True) -> SplatCloud:
    """The splats at rest, without modifiers, in world space or (world=False) in the object's own.

    Raises InputError: not a splat object, in Edit Mode, missing attributes, non-uniform or mirrored scale.
    """
    if not is_splat_object(obj):
        raise InputError(
            f"'{getattr(obj, 'name', obj)}' is no splat object; import a Gaussian splat .ply and select it."
        )
    refuse_edit_mode(obj)
    mesh: ObjectData = obj.data
    if len(mesh.vertices) == 0:
        raise InputError(f"'{obj.name}' has no splats left; import it again.")
    base = _require(obj, names.BASE)
    degree = int(mesh[names.MARK].get("sh_degree", 0))
    coefficients = (degree + 1) ** 2
    sh = np.empty((len(base), coefficients, 3), dtype=np.float32)
    sh[:, 0] = base[:, :3]
    for index in range(coefficients - 1):
        sh[:, index + 1] = _require(obj, names.SH.format(index))
    cloud = SplatCloud(
        means=read_positions(mesh),
        quats=normalize(_require(obj, names.ROTATION)),
        scales=np.maximum(_require(obj, names.SCALE), 0.0),
        opacities=np.clip(base[:, 3], 0.0, 1.0),
        sh=sh,
        extra=read_extra(mesh),
        offset=np.array(obj.get(names.GEO_OFFSET, (0.0, 0.0, 0.0))),
    )
    return to_world(cloud, obj) if world else cloud


def replace_cloud(obj: bpy.types.Object, cloud: SplatCloud) -> None:
    """Overwrite the splats of `obj` (same number, object space); modifiers and vertex groups stay."""
    if cloud.count != splat_count(obj):
        raise InputError(
            f"'{obj.name}' has {splat_count(obj)} splats and the new values are for {cloud.count}; "
            "create a new object for them."
        )
    mesh: ObjectData = obj.data
    run_to_end(_column_steps(mesh, cloud))
    if names.REST in mesh.attributes:
        write_attribute(mesh, names.REST, "FLOAT_VECTOR", cloud.means)


def refuse_edit_mode(obj: bpy.types.Object) -> None:
    """InputError while the object's mesh is being edited: its attributes are elsewhere then."""
    if obj.mode == "EDIT":
        raise InputError(f"'{obj.name}' is in Edit Mode; leave it (Tab) and try again.")


def _column_steps(mesh: bpy.types.Mesh, cloud: SplatCloud) -> Steps[None]:
    """Write every value of the cloud, one attribute after the other."""
    write_positions(mesh, cloud.means)
    yield 0.1
    write_attribute(mesh, names.ROTATION, "QUATERNION", cloud.quats)
    yield 0.15
    write_attribute(mesh, names.SCALE, "FLOAT_VECTOR", cloud.scales)
    yield 0.2
    base = np.empty((cloud.count, 4), dtype=np.float32)
    base[:, :3], base[:, 3] = cloud.sh[:, 0], cloud.opacities
    write_attribute(mesh, names.BASE, "FLOAT_COLOR", base)
    yield 0.25
    coefficients = cloud.sh.shape[1] - 1
    for index in range(coefficients):
        write_attribute(mesh, names.SH.format(index), "FLOAT_VECTOR", cloud.sh[:, index + 1])
        yield 0.25 + 0.65 * (index + 1) / coefficients
    columns = write_extra(mesh, {})
    for number, (column, values) in enumerate(cloud.extra.items()):
        told = write_extra(mesh, {column: values})
        columns = {key: f"{columns[key]}\n{text}" if number else text for key, text in told.items()}
        yield 0.9
    mark = mesh.get(names.MARK)
    up = None if mark is None else mark.get("up")
    mesh[names.MARK] = {"version": VERSION, "sh_degree": cloud.sh_degree, **columns}
    if up is not None:
        mesh[names.MARK]["up"] = up
    remember_places(mesh)


def remember_places(mesh: bpy.types.Mesh) -> None:
    """Store where a few splats are, as a sign that all attributes fit these positions (see `follow_transforms.py`)."""
    count = len(mesh.vertices)
    index = np.linspace(0, count - 1, min(count, _PLACES)).astype(int)
    places = np.array([mesh.vertices[i].co for i in index.tolist()], dtype=np.float64)
    mesh[names.PLACES] = {"count": count, "index": index.tolist(), "points": places.ravel().tolist()}


def reference_points(mesh: bpy.types.Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Stored and present positions (k, 3) of a few splats; None where none are stored for this number of splats."""
    stored = mesh.get(names.PLACES)
    if stored is None or stored["count"] != len(mesh.vertices):
        return None
    now = np.array([mesh.vertices[i].co for i in stored["index"]], dtype=np.float64)
    return np.array(stored["points"], dtype=np.float64).reshape(-1, 3), now


def _require(obj: bpy.types.Object, name: str) -> NDArray[Any]:
    values = read_attribute(obj.data, name)
    if values is None:
        raise InputError(f"'{obj.name}' has lost its splat attribute '{name}'; import the splats again.")
    return values


def to_world(cloud: SplatCloud, obj: bpy.types.Object) -> SplatCloud:
    """A cloud in the object's space, in world space. InputError for non-uniform or mirrored scale."""
    rotation, scale, translation = world_similarity(obj)
    if scale == 1.0 and not translation.any() and np.array_equal(rotation, np.eye(3)):
        return cloud
    turned = rotate_cloud(cloud, rotation)
    return replace(turned, means=turned.means * scale + translation, scales=turned.scales * scale)
