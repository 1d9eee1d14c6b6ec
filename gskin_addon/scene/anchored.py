# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats anchored to a proxy mesh of the scene (Eq. 4-5): they follow whatever deforms it, live.

The splats keep face, barycentrics, offset and residual as attributes. The anchor mesh is a helper in no
collection, like the bone frames: the proxy's triangles at rest with the coefficients of its one-ring maps. The proxy
itself is not touched; armatures, shape keys, cloth and lattices all carry the splats.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.anchoring import Anchors, anchor_splats, check_fit
from ..core.rig.vertex_maps import rest_rings
from . import names
from .anchor_nodes import MESH_INPUT, PROXY_INPUT, anchor_group, find_anchor
from .attributes import ObjectData, read_attribute, read_positions, write_attribute, write_positions
from .bone_frames import armature_modifier
from .helpers import hide_helper
from .node_builder import add_modifier, get_input, set_input
from .node_groups import find_display
from .rotation_nodes import find_rotation
from .splat_object import is_splat_object, read_cloud, refuse_edit_mode

Array = NDArray[Any]

_ATTRIBUTES = (names.FACE, names.BARY, names.BETA, names.RESIDUAL, names.REACH)


def anchor_to_mesh(
    obj: bpy.types.Object, proxy: bpy.types.Object, *, keep_residual: bool = True, edges_only: bool = False
) -> Anchors:
    """Let the splats of `obj` follow the mesh object `proxy`, both as they are at rest (without modifiers).

    An Armature modifier of the splats and the rotation nodes that go with it are taken off, since the proxy moves
    the splats now; vertex groups stay. Anchoring again replaces the anchors. edges_only: see
    `core.rig.vertex_maps.rest_rings`.

    Raises InputError: no splats, no usable mesh, modifiers that change the mesh's points, a mesh elsewhere.
    """
    found = find_anchors(obj, proxy, keep_residual=keep_residual)
    attach(obj, proxy, *found, edges_only=edges_only)
    return found[0]


def find_anchors(
    obj: bpy.types.Object, proxy: bpy.types.Object, *, keep_residual: bool = True
) -> tuple[Anchors, Array, Array]:
    """What `anchor_to_mesh` would anchor, with verts (V, 3) in the splats' own space and faces (F, 3).

    Changes nothing. Raises InputError as `anchor_to_mesh` does.
    """
    cloud = read_cloud(obj, world=False)
    verts, faces = read_mesh(proxy)
    bpy.context.view_layer.update()
    evaluated = proxy.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if len(evaluated.data.vertices) != len(verts):
        raise InputError(
            f"'{proxy.name}' has modifiers that change its points ({len(verts)} to {len(evaluated.data.vertices)}); "
            "apply them, or switch them off in the viewport, and anchor again."
        )
    to_splats = np.linalg.inv(np.array(obj.matrix_world)) @ np.array(proxy.matrix_world)
    verts = verts @ to_splats[:3, :3].T + to_splats[:3, 3]
    label = f"'{proxy.name}'"
    anchors = anchor_splats(cloud.means, verts, faces, keep_residual=keep_residual, label=label)
    check_fit(anchors, cloud.means, verts, faces, label)
    return anchors, verts, faces


def attach(
    obj: bpy.types.Object,
    proxy: bpy.types.Object,
    anchors: Anchors,
    verts: Array,
    faces: Array,
    *,
    edges_only: bool = False,
) -> None:
    """Hang the splats on the mesh by what `find_anchors` found; edges_only: as in `anchor_to_mesh`."""
    mesh = obj.data
    write_attribute(mesh, names.FACE, "INT", anchors.face)
    write_attribute(mesh, names.BARY, "FLOAT_VECTOR", anchors.bary)
    write_attribute(mesh, names.BETA, "FLOAT", anchors.beta)
    write_attribute(mesh, names.RESIDUAL, "FLOAT_VECTOR", anchors.residual)
    write_attribute(mesh, names.REACH, "FLOAT", anchors.reach)
    mesh.update()
    for other in (find_rotation(obj), armature_modifier(obj)):
        if other is not None:
            obj.modifiers.remove(other)
    modifier = find_anchor(obj)
    if modifier is None:
        modifier = add_modifier(obj, names.ANCHOR_MODIFIER)
        display = find_display(obj)
        if display is not None:
            obj.modifiers.move(obj.modifiers.find(modifier.name), obj.modifiers.find(display.name))
    modifier.node_group = anchor_group()
    set_input(modifier, PROXY_INPUT, proxy)
    set_input(modifier, MESH_INPUT, _anchor_mesh(proxy.name, verts, faces, edges_only))


def release(obj: bpy.types.Object) -> None:
    """Take the splats off their proxy mesh again; they are at rest, attributes and modifier gone."""
    modifier = find_anchor(obj)
    if modifier is not None:
        obj.modifiers.remove(modifier)
    for name in _ATTRIBUTES:
        attribute = obj.data.attributes.get(name)
        if attribute is not None:
            obj.data.attributes.remove(attribute)


def proxy_of(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The mesh object that the splats are anchored to."""
    modifier = find_anchor(obj)
    return None if modifier is None else get_input(modifier, PROXY_INPUT)


def read_anchors(obj: bpy.types.Object) -> tuple[Anchors, Array, Array]:
    """The object's anchors, and verts (V, 3) at rest and faces (F, 3) of their mesh, in the object's own space.

    Raises InputError where the object is not anchored.
    """
    modifier = find_anchor(obj)
    helper = None if modifier is None else get_input(modifier, MESH_INPUT)
    values = [read_attribute(obj.data, name) for name in _ATTRIBUTES]
    if helper is None or any(value is None for value in values):
        raise InputError(f"'{obj.name}' is not anchored to a mesh; anchor it first.")
    face, bary, beta, residual, reach = (np.asarray(value, np.float64) for value in values)
    anchors = Anchors(face.astype(np.int64), bary, beta, residual, reach, np.zeros(len(face)))
    return anchors, read_positions(helper.data).astype(np.float64), _triangles(helper.data)


def has_edges_only(obj: bpy.types.Object) -> bool:
    """Whether the splats were anchored with `edges_only`."""
    modifier = find_anchor(obj)
    helper = None if modifier is None else get_input(modifier, MESH_INPUT)
    return helper is not None and bool(helper.get(names.EDGES_ONLY, False))


def read_mesh(proxy: bpy.types.Object) -> tuple[Array, Array]:
    """Vertices (V, 3) float64 in the object's own space and triangles (F, 3) of a mesh object, without modifiers.

    Raises InputError: no mesh, splats, in Edit Mode, no faces.
    """
    if proxy is None or proxy.type != "MESH" or is_splat_object(proxy):
        raise InputError(f"'{getattr(proxy, 'name', proxy)}' is no mesh to anchor to; choose a mesh with faces.")
    refuse_edit_mode(proxy)
    faces = _triangles(proxy.data)
    if len(faces) == 0:
        raise InputError(f"'{proxy.name}' has no faces; choose a mesh with a surface.")
    return read_positions(proxy.data).astype(np.float64), faces


def read_world_mesh(proxy: bpy.types.Object) -> tuple[Array, Array]:
    """`read_mesh` in world space."""
    verts, faces = read_mesh(proxy)
    bpy.context.view_layer.update()
    matrix = np.array(proxy.matrix_world, dtype=np.float64)
    return verts @ matrix[:3, :3].T + matrix[:3, 3], faces


def _triangles(mesh: ObjectData) -> Array:
    mesh.calc_loop_triangles()
    flat = np.empty(3 * len(mesh.loop_triangles), dtype=np.int32)
    mesh.loop_triangles.foreach_get("vertices", flat)
    return flat.reshape(-1, 3).astype(np.int64)


def _anchor_mesh(name: str, verts: Array, faces: Array, edges_only: bool) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(f"GSkin Anchor Mesh ({name})")
    mesh.vertices.add(len(verts))
    mesh.loops.add(faces.size)
    mesh.polygons.add(len(faces))
    mesh.loops.foreach_set("vertex_index", faces.ravel().astype(np.int32))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    write_positions(mesh, verts)
    for label, shift in ((names.CORNER_NEXT, -1), (names.CORNER_LAST, 1)):
        indices: Any = mesh.attributes.new(label, "INT", "CORNER")
        indices.data.foreach_set("value", np.roll(faces, shift, axis=1).ravel().astype(np.int32))
    rings = rest_rings(verts, faces, edges_only=edges_only)
    shares: Any = mesh.attributes.new(names.RING_SHARE, "FLOAT", "CORNER")
    shares.data.foreach_set("value", rings.shares.ravel().astype(np.float32))
    coefficients = rings.coefficients.reshape(-1, 3, 3)
    for k, label in enumerate(names.MAP_COEFFICIENTS):
        values = np.ascontiguousarray(coefficients[:, k], dtype=np.float32).ravel()
        rows: Any = mesh.attributes.new(label, "FLOAT_VECTOR", "CORNER")
        rows.data.foreach_set("vector", values)
    helper = bpy.data.objects.new(mesh.name, mesh)
    helper[names.ANCHOR_MARK] = True
    helper[names.EDGES_ONLY] = edges_only
    hide_helper(helper)
    return helper
