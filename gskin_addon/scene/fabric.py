# SPDX-License-Identifier: GPL-3.0-or-later
"""The fabric under splats: triangles between neighbours, on which Blender's own weight tools work.

The vertices stay the splats, in their order. Nothing draws it but Weight Paint and Edit Mode (`fabric_view.py`), and
what is exported goes without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bmesh
import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.skinning.edits.separate import FAR, steps_between
from ..core.skinning.fabric import Fabric, fabric_triangles
from ..core.skinning.walls import blocked
from .armature import deform_bone_names, read_skeleton
from .attributes import ObjectData, read_flags
from .bone_frames import armature_of
from .influences import strongest_bone
from .object_ref import ObjectRef, object_by_uid
from .seams import read_seams
from .splat_object import is_splat_object, read_cloud, refuse_edit_mode
from .steps import Steps, in_thread
from .vertex_groups import leave_paint_mode, set_mode

Array = NDArray[Any]

_EDGE, _CORNER, _SIDE = ".edge_verts", ".corner_vert", ".corner_edge"
"""Attributes in which Blender keeps the edges' points, and of each corner of a face the point and the edge."""

_aside: list[tuple[int, str, int, int]] = []
"""Session id and name of objects whose fabric is laid aside, with those of the meshes with and without it."""


def has_fabric(obj: bpy.types.Object) -> bool:
    """Whether the splats have a fabric."""
    return is_splat_object(obj) and len(obj.data.polygons) > 0


def iter_make_fabric(obj: bpy.types.Object) -> Steps[int]:
    """Give the splats of `obj` a new fabric in place of an older one; the number of its triangles. In slices; only the
    last one changes the scene.

    Raises InputError: no splats, Edit Mode, or the object was changed meanwhile.
    """
    ref = ObjectRef(obj)
    fabric = yield from iter_fabric(obj, strongest_bone(obj), armature_of(obj))
    obj = ref.find()
    lay_under(obj, fabric)
    return len(fabric.triangles)


def iter_fabric(
    obj: bpy.types.Object, bone: Array | None, armature: bpy.types.Object | None
) -> Steps[Fabric]:
    """A fabric for the splats of `obj`, made in a thread.

    Splats are not joined over seams, nor where the bones of `armature` that move them most, bone (N,) with -1 for none,
    are far apart in the skeleton. Raises InputError as `read_cloud`.
    """
    cloud, walls, apart = read_cloud(obj), read_seams(obj), None
    if armature is not None and bone is not None:
        parents = read_skeleton(armature).parents
        # The last row is of splats that no bone moves, index -1: they are far from nothing.
        far = np.zeros((len(parents) + 1, len(parents) + 1), np.bool_)
        far[:-1, :-1] = steps_between(parents) >= FAR
        apart = bone, far
    return (yield from in_thread(lambda: Fabric.of(fabric_triangles(cloud, walls=walls, apart=apart))))


def strongest_of(weights: Array, bones: Sequence[str], armature: bpy.types.Object) -> Array:
    """(N,) the deform bone of `armature`, by number, with the most of weights (N, B) of `bones`; -1 for none."""
    place = {name: number for number, name in enumerate(deform_bone_names(armature))}
    number = np.array([place.get(name, -1) for name in bones])
    strongest = weights.argmax(axis=1)
    return np.where(weights[np.arange(len(weights)), strongest] > 0, number[strongest], -1)


def lay_under(obj: bpy.types.Object, fabric: Fabric) -> None:
    """Give the splats a fabric in place of an older one. Raises InputError in Edit Mode."""
    refuse_edit_mode(obj)
    mode = leave_paint_mode(obj)
    strip_fabric(obj.data)
    _add(obj.data, fabric)
    if mode != "OBJECT":
        set_mode(obj, mode)


def cut_fabric(obj: bpy.types.Object, labels: Array) -> None:
    """Take away what of the fabric lies over walls, in Edit Mode from what is edited; labels (N,), see `walls`."""
    if obj.mode == "EDIT":
        _cut_edited(obj.data, labels)
        return
    if not has_fabric(obj):
        return
    edges, triangles, sides = _read(obj.data, _EDGE, 2), _read(obj.data, _CORNER, 3), _read(obj.data, _SIDE, 3)
    stay = ~blocked(labels[edges[:, 0]], labels[edges[:, 1]])
    whole = stay[sides].all(axis=1)
    number = np.cumsum(stay) - 1
    lay_under(obj, Fabric(triangles[whole], edges[stay], number[sides[whole]]))


def _cut_edited(mesh: ObjectData, labels: Array) -> None:
    work = bmesh.from_edit_mesh(mesh)
    work.verts.ensure_lookup_table()
    work.verts.index_update()
    label = labels.tolist()
    there, count = np.unique(labels[labels != 0], return_counts=True)
    if len(there) < 2:
        return
    most = there[count.argmax()]  # what is cut has another label at one end
    cut = set()
    for point in np.flatnonzero((labels != 0) & (labels != most)).tolist():
        vert = work.verts[point]
        for edge in vert.link_edges:
            other = label[edge.other_vert(vert).index]
            if other and other != label[point]:
                cut.add(edge)
    for edge in cut:
        work.edges.remove(edge)  # and its triangles; the points stay
    bmesh.update_edit_mesh(mesh)


def strip_fabric(mesh: ObjectData) -> None:
    """Take edges and triangles away from a mesh of splats; its points and all that they carry stay."""
    if not len(mesh.polygons) and not len(mesh.edges):
        return
    # Edges and triangles with equal ends are none: of all that removes some and leaves the points as they are, this
    # is by far the quickest.
    for name, size in ((_CORNER, len(mesh.loops)), (_EDGE, 2 * len(mesh.edges))):
        if size:
            mesh.attributes[name].data.foreach_set("value", np.zeros(size, np.int32))
    mesh.validate(clean_customdata=False)
    # The layers of corners and edges that this leaves have no memory, and Blender crashes where some are added again.
    work = bmesh.new()
    work.from_mesh(mesh)
    work.to_mesh(mesh)
    work.free()
    mesh.update()


def read_fabric(mesh: ObjectData) -> tuple[Array, Array]:
    """Triangles (T, 3) and edges (E, 2) of the fabric in a mesh of splats, none where it has none; a millisecond, but
    for a mesh in Edit Mode, of which they are slowly read as they were when it was entered."""
    if not len(mesh.polygons):
        return np.empty((0, 3), np.int32), np.empty((0, 2), np.int32)
    if mesh.is_editmode:
        triangles, edges = np.empty(len(mesh.loops), np.int32), np.empty(2 * len(mesh.edges), np.int32)
        mesh.loops.foreach_get("vertex_index", triangles)
        mesh.edges.foreach_get("vertices", edges)
        return triangles.reshape(-1, 3), edges.reshape(-1, 2)
    return _read(mesh, _CORNER, 3), _read(mesh, _EDGE, 2)


def lay_fabrics_aside() -> None:
    """Give all splat objects a mesh without fabric, until `bring_fabrics_back`: exporters write what they find."""
    for obj in bpy.data.objects:
        if has_fabric(obj) and obj.mode != "EDIT":
            mesh: ObjectData = obj.data
            bare = mesh.copy()
            strip_fabric(bare)
            obj.data = bare
            _aside.append((obj.session_uid, obj.name, mesh.session_uid, bare.session_uid))


def bring_fabrics_back() -> None:
    """Undo `lay_fabrics_aside`."""
    while _aside:
        uid, name, whole, bare = _aside.pop()
        meshes = {mesh.session_uid: mesh for mesh in bpy.data.meshes if mesh.session_uid in (whole, bare)}
        obj = object_by_uid(uid, name)
        if obj is not None and whole in meshes:
            obj.data = meshes[whole]
        if bare in meshes and not meshes[bare].users:
            bpy.data.meshes.remove(meshes[bare])


def _read(mesh: ObjectData, name: str, width: int) -> Array:
    """(K, width) int32: one of the attributes above."""
    values = mesh.attributes[name].data
    flat = np.empty(len(values) * (2 if name == _EDGE else 1), np.int32)
    values.foreach_get("value", flat)
    return flat.reshape(-1, width)


def _add(mesh: ObjectData, fabric: Fabric) -> None:
    """Blender need not look for the edges, and takes whole arrays where they are attributes."""
    count = len(fabric.triangles)
    if not count:
        return
    mesh.edges.add(len(fabric.edges))
    mesh.loops.add(3 * count)
    mesh.polygons.add(count)
    for name, values in ((_EDGE, fabric.edges), (_CORNER, fabric.triangles), (_SIDE, fabric.sides)):
        mesh.attributes[name].data.foreach_set("value", np.ascontiguousarray(values, np.int32).ravel())
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    select_with_points(mesh)  # Blender gives new ones as selected
    mesh.update()


def select_with_points(mesh: ObjectData) -> None:
    """Let exactly those edges and faces of a mesh be selected whose points all are: Edit Mode would select the points
    of others with them. Outside of Edit Mode."""
    selected = read_flags(mesh, "select")
    if ".select_edge" in mesh.attributes:
        whole = selected[_read(mesh, _EDGE, 2)].all(axis=1)
        mesh.attributes[".select_edge"].data.foreach_set("value", np.ascontiguousarray(whole))
    if ".select_poly" in mesh.attributes and len(mesh.polygons):
        starts = np.empty(len(mesh.polygons), np.int32)
        mesh.polygons.foreach_get("loop_start", starts)
        corners = selected[_read(mesh, _CORNER, 1)[:, 0]]
        mesh.attributes[".select_poly"].data.foreach_set("value", np.logical_and.reduceat(corners, starts))
