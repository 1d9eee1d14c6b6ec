# SPDX-License-Identifier: GPL-3.0-or-later
"""What Edit Mode selects on, read for the marks: the posed points of edited splats, and the fabric between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .marks import Cage
from .reading import posed_positions
from .selection import flags_of
from .visible import Shown

_points: dict[int, tuple[Any, NDArray[np.float32]]] = {}
_fabric: dict[int, tuple[Any, NDArray[np.int32], NDArray[np.int32]]] = {}
"""By session id of an object: for what they were read, and what was read."""


def edited_cages(context: bpy.types.Context, shown: Sequence[Shown]) -> list[Cage]:
    """The cages of those shown objects whose points are being selected."""
    cages = []
    for one in shown:
        flags = flags_of(one.obj)
        if flags is None:
            continue
        points = _read_points(one, context)
        if points is None or len(points) != len(flags.selected):
            continue  # not evaluated yet, or modifiers of other people leave splats out
        triangles, edges = _read_fabric(one.obj, len(points))
        solid_key = (one.pose_key, flags.hides)
        cages.append(
            Cage(points, one.splats.matrix, flags.selected, flags.hidden, flags.active, triangles, edges,
                 (solid_key, flags.state, one.splats.matrix.tobytes()), (solid_key, one.splats.matrix.tobytes()))
        )  # fmt: skip
    return cages


def _read_points(one: Shown, context: bpy.types.Context) -> NDArray[np.float32] | None:
    uid = one.obj.session_uid
    if uid not in _points or _points[uid][0] != one.pose_key:
        points = posed_positions(one.obj.evaluated_get(context.view_layer.depsgraph))
        if points is None:
            return None
        _points[uid] = one.pose_key, points
    return _points[uid][1]


def _read_fabric(obj: bpy.types.Object, count: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Triangles (T, 3) and edges (E, 2), as they were when Edit Mode was entered: none where points were added or
    removed since."""
    mesh: Any = obj.data
    uid, state = obj.session_uid, (mesh.session_uid, len(mesh.vertices), len(mesh.edges), len(mesh.loops), count)
    if uid not in _fabric or _fabric[uid][0] != state:
        triangles, edges = np.empty((0, 3), np.int32), np.empty((0, 2), np.int32)
        if len(mesh.vertices) == count:
            edges = np.empty((len(mesh.edges), 2), np.int32)
            mesh.edges.foreach_get("vertices", edges.ravel())
            if len(mesh.loops) == 3 * len(mesh.polygons):
                triangles = np.empty((len(mesh.polygons), 3), np.int32)
                mesh.loops.foreach_get("vertex_index", triangles.ravel())
        _fabric[uid] = state, triangles, edges
    return _fabric[uid][1:]


def forget() -> None:
    """Have everything read again."""
    _points.clear()
    _fabric.clear()
