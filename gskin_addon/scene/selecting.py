# SPDX-License-Identifier: GPL-3.0-or-later
"""Selections of splats, in whatever mode the artist is, and what they are made from: the body, colours, bones."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import bmesh
import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import GSkinError
from ..core.skinning.edits.body_graph import BodyGraph, body_graph
from ..core.splats.cloud import SH_C0
from . import names
from .attributes import ObjectData, read_attribute, read_flags, read_positions
from .fabric import select_with_points
from .seams import read_seams
from .splat_object import read_cloud
from .stand_in import mesh_uid
from .steps import Steps, in_thread, run_to_end
from .transforms import points_in_world

Array = NDArray[Any]
Mask = NDArray[np.bool_]

_graphs: dict[int, tuple[tuple[int, ...], BodyGraph]] = {}
"""By session id of a mesh: what the graph was made of, and the graph. The last few."""
_KEPT = 3


def body_of(obj: bpy.types.Object) -> BodyGraph:
    """The graph of the body of a splat object at rest, in world space; kept until the splats or their seams change.

    Raises InputError as `read_cloud`.
    """
    return run_to_end(iter_body_of(obj))


def iter_body_of(obj: bpy.types.Object) -> Steps[BodyGraph]:
    """`body_of` in slices: the graph is made beside Blender. Already the first slice raises."""
    make = body_maker(obj)
    return (yield from in_thread(make))


def body_maker(obj: bpy.types.Object) -> Callable[[], BodyGraph]:
    """A function that gives `body_of`, for a thread: it reads Blender now and not when it is called.

    Raises InputError as `read_cloud`.
    """
    sides = read_seams(obj)
    means = read_cloud(obj).means
    made_of = (len(means), zlib.crc32(means.tobytes()), 0 if sides is None else zlib.crc32(sides.tobytes()))
    uid = mesh_uid(obj)

    def make() -> BodyGraph:
        known = _graphs.get(uid)
        if known is not None and known[0] == made_of:
            return known[1]
        graph = body_graph(means, walls=sides)
        while len(_graphs) >= _KEPT:
            _graphs.pop(next(iter(_graphs)))
        _graphs[uid] = made_of, graph
        return graph

    return make


def base_colors(obj: bpy.types.Object) -> Array:
    """sRGB colours (N, 3) of the splats, the same from all sides."""
    base = read_attribute(obj.data, names.BASE)
    return np.clip(0.5 + SH_C0 * np.asarray(base)[:, :3], 0, 1)


def selected_now(obj: bpy.types.Object) -> Mask:
    """(N,) the splats that are selected and not hidden. Outside of Edit Mode."""
    return read_flags(obj.data, "select") & ~hidden_now(obj)


def hidden_now(obj: bpy.types.Object) -> Mask:
    """(N,) the splats that Edit Mode and Weight Paint hide. Outside of Edit Mode."""
    return read_flags(obj.data, "hide")


def active_splat(obj: bpy.types.Object) -> int | None:
    """The splat that was clicked last in Edit Mode; None where none is known."""
    if obj.mode != "EDIT":
        return None
    mesh: ObjectData = obj.data
    active = bmesh.from_edit_mesh(mesh).select_history.active
    return active.index if isinstance(active, bmesh.types.BMVert) else None


def mark_selected(obj: bpy.types.Object, mask: Mask) -> None:
    """Select exactly the splats of `mask` (N,), outside of Edit Mode, which then shows these; to go there see
    `enter_edit_mode`."""
    obj.data.vertices.foreach_set("select", np.ascontiguousarray(mask, np.bool_))
    select_with_points(obj.data)
    obj.data.update()


def enter_edit_mode(context: bpy.types.Context, obj: bpy.types.Object, mask: Mask) -> None:
    """Go to Edit Mode on the active object's points with exactly the splats of `mask` (N,) selected, and what of the
    fabric lies between them."""
    context.tool_settings.mesh_select_mode = (True, False, False)
    bpy.ops.object.mode_set(mode="EDIT")
    # Edges and faces of the fabric have the selection of before, and would bring their points along.
    bpy.ops.mesh.select_all(action="DESELECT")
    mesh: ObjectData = obj.data
    work = bmesh.from_edit_mesh(mesh)
    work.verts.ensure_lookup_table()
    verts = work.verts
    for index in np.flatnonzero(mask).tolist():
        verts[index].select = True
    work.select_flush_mode()
    bmesh.update_edit_mesh(mesh, loop_triangles=False, destructive=False)


def posed_points(obj: bpy.types.Object) -> Array:
    """(N, 3) where the splats are now in the world, as Blender evaluates their modifiers but for the display.

    Raises GSkinError: in Edit Mode, where a modifier leaves splats out.
    """
    from .node_groups import find_display

    if obj.mode == "EDIT":
        data: ObjectData = obj.data
        count = len(bmesh.from_edit_mesh(data).verts)
        edited: Any = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
        # Behind the splats there may be points that the display adds for the shader.
        points = read_positions(edited.to_mesh())[:count].astype(np.float64)
        edited.to_mesh_clear()
        if len(points) != count:
            raise GSkinError(f"Modifiers of '{obj.name}' change how many splats there are; switch them off here.")
        return points_in_world(points, edited)
    display = find_display(obj)
    shown = display is not None and display.show_viewport
    if shown:
        display.show_viewport = False
    try:
        evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
        points = read_positions(evaluated.data).astype(np.float64)
    finally:
        if shown:
            display.show_viewport = True
    if len(points) != len(obj.data.vertices):
        points = read_positions(obj.data).astype(np.float64)
    return points_in_world(points, evaluated)
