# SPDX-License-Identifier: GPL-3.0-or-later
"""What Edit Mode selects on, read for the marks: the posed points of edited splats, and the fabric between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..fabric import read_fabric
from ..splat_object import is_splat_object
from .marks import Cage
from .reading import posed_positions
from .selection import flags_of
from .visible import Shown

_points: dict[int, tuple[Any, NDArray[np.float32]]] = {}
_fabric: dict[int, tuple[Any, Any, NDArray[np.int32], NDArray[np.int32]]] = {}
"""By session id of an object: for what they were read, and what was read."""


def edited_cages(context: bpy.types.Context, shown: Sequence[Shown]) -> list[Cage]:
    """The cages of those shown objects whose points are being selected."""
    cages = []
    for one in shown:
        flags = flags_of(one.obj) if is_splat_object(one.obj) else None  # else what makes instances
        if flags is None:
            continue
        points = _read_points(one, context)
        if points is None or len(points) != len(flags.selected):
            continue  # not evaluated yet, or modifiers of other people leave splats out
        triangles, edges = _fabric_of(one.obj)
        if len(one.obj.data.vertices) != len(points):
            triangles, edges = triangles[:0], edges[:0]  # points were added or removed since Edit Mode was entered
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


def remember_fabrics(shown: Sequence[Shown]) -> None:
    """Have the fabrics ready for when Edit Mode is entered, where reading them takes a fifth of a second."""
    for one in shown:
        if is_splat_object(one.obj) and one.obj.mode != "EDIT" and len(one.obj.data.polygons):
            _fabric_of(one.obj, one.rest_key)


def _fabric_of(obj: bpy.types.Object, rest_key: Any = None) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Triangles (T, 3) and edges (E, 2) of an object's fabric; read again for another `rest_key`."""
    mesh: Any = obj.data
    uid, state = obj.session_uid, (mesh.session_uid, len(mesh.vertices), len(mesh.edges), len(mesh.loops))
    known = _fabric.get(uid)
    if known is None or known[0] != state or rest_key not in (None, known[1]):
        known = _fabric[uid] = (state, rest_key, *read_fabric(mesh))
    return known[2:]


def forget() -> None:
    """Have everything read again."""
    _points.clear()
    _fabric.clear()
