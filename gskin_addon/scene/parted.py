# SPDX-License-Identifier: GPL-3.0-or-later
"""After Join (Ctrl-J) and Separate (P) of splat objects: what Blender leaves wrong is put right.

Join moves the positions of what is joined into the active object's space and nothing else: rotations, sizes and
harmonics of those splats are turned and scaled here by the same map. Separate takes the faces of the selection along
and leaves behind every splat that another face of the fabric holds: these are removed.

Which splats came from where is told by the few places that every mesh remembers (`names.PLACES`): a mesh that has more
splats than it remembers was joined, and the objects that were seen before say the rest. So a state that undo or redo
brings back is recognised and put right as well.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import bmesh
import bpy
import numpy as np
from bpy.app.handlers import persistent
from numpy.typing import NDArray

from ..core.errors import GSkinError
from ..core.splats.axes import rotate_cloud
from ..core.splats.cloud import MAX_SH_DEGREE
from ..core.splats.similarity import rigid_part
from . import names
from .attributes import ObjectData, read_attribute, read_positions, write_attribute
from .compared import drop_kept, is_edited, mark_edited
from .fabric import has_fabric
from .fabric_renewal import renew_later
from .object_ref import object_by_uid
from .splat_object import is_splat_object, read_cloud, reference_points, remember_places, replace_cloud

Array = NDArray[Any]
CLASSES = ()

_NEAR = 1e-5
"""Places that differ by less than this part of the splats' extent are one."""


@dataclass(frozen=True)
class _Seen:
    """A splat object as it was seen last: what is needed to find its splats in another mesh, and what the mesh says.

    index (k,), points (k, 3): some splats and their places; matrix (4, 4): to the world.
    """

    count: int
    index: Array
    points: Array
    matrix: Array
    edited: bool
    sure: bool
    compared: Any
    extra: tuple[str, str]


_seen: dict[int, _Seen] = {}
"""By session id. What is gone stays: undo may bring back the moment when it was joined."""


@persistent
def follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Look at the splat objects that were moved or changed; a pose is neither."""
    updates = list(depsgraph.updates)
    meshes = {update.id.original.session_uid for update in updates if isinstance(update.id, bpy.types.Mesh)}
    found = []
    for update in updates:
        obj = update.id.original if isinstance(update.id, bpy.types.Object) else None
        if obj is None or not is_splat_object(obj) or obj.library is not None or obj.data.library is not None:
            continue
        if update.is_updated_transform or obj.data.session_uid in meshes or obj.session_uid not in _seen:
            found.append(obj)
    _look_at(found)


@persistent
def start_over(*_: object) -> None:
    """Another file: session ids mean nothing any more."""
    _seen.clear()
    _look_at([obj for obj in bpy.data.objects if is_splat_object(obj) and obj.library is None])


def _look_at(objects: Iterable[bpy.types.Object]) -> None:
    objects = list(objects)
    edited = [obj for obj in objects if obj.mode == "EDIT"]
    for obj in objects:
        if obj.mode == "EDIT" or not obj.users_scene:
            continue
        mesh: ObjectData = obj.data
        stored = mesh.get(names.PLACES)
        if stored is not None and stored["count"] != len(obj.data.vertices):
            try:
                if stored["count"] > len(obj.data.vertices):
                    for other in edited:
                        _remove_left_behind(other, obj)
                else:
                    _mend_joined(obj)
            except GSkinError as error:
                print(f"gskin: {error}")  # nobody to report to
            remember_places(mesh)
        _note(obj)


def _note(obj: bpy.types.Object) -> None:
    mesh: ObjectData = obj.data
    found = reference_points(mesh)
    if found is None:
        return
    mark: Any = mesh[names.MARK]
    _seen[obj.session_uid] = _Seen(
        count=len(obj.data.vertices),
        index=np.array(obj.data[names.PLACES]["index"].to_list(), np.int64),
        points=found[1],
        matrix=np.array(obj.matrix_world, np.float64),
        edited=is_edited(obj),
        sure=names.CONFIDENCE in obj.data.attributes,
        compared=None if names.COMPARED not in mesh else mesh[names.COMPARED].to_dict(),
        extra=(str(mark.get("extra", "")), str(mark.get("types", ""))),
    )


# --- joined


def _mend_joined(obj: bpy.types.Object) -> None:
    """Let rotations, sizes and harmonics of the splats that were joined to those of `obj` follow their places."""
    mesh: ObjectData = obj.data
    _mend_mark(mesh)
    parts = _parts_of(obj)
    if not parts:
        return
    joined = [seen for _, seen in parts if seen is not None]
    if not joined:
        return
    own = np.linalg.inv(np.array(obj.matrix_world, np.float64))
    cloud = read_cloud(obj, world=False)
    quats, scales, sh, turned = cloud.quats.copy(), cloud.scales.copy(), cloud.sh.copy(), False
    for rows, seen in parts:
        if seen is None:
            continue
        found = rigid_part((own @ seen.matrix)[:3, :3])
        if found is None:
            mesh[names.MARK]["warning"] = (
                "Joined splats that were scaled unevenly or mirrored: they cannot follow; undo, and give all axes one "
                "positive scale"
            )
            continue
        rotation, scale = found
        if np.allclose(rotation, np.eye(3), atol=1e-6) and abs(scale - 1) < 1e-6:
            continue
        part = rotate_cloud(cloud.select(rows), rotation)
        quats[rows], scales[rows], sh[rows], turned = part.quats, part.scales * np.float32(scale), part.sh, True
    if turned:
        replace_cloud(obj, replace(cloud, quats=quats, scales=scales, sh=sh))
    _mend_records(obj, parts)
    mesh.update()
    if has_fabric(obj):
        renew_later(obj)


def _parts_of(obj: bpy.types.Object) -> list[tuple[slice, _Seen | None]]:
    """Where in the mesh of `obj` the splats of which object are, None for its own; empty where it cannot be told."""
    stored = obj.data[names.PLACES]
    points = read_positions(obj.data).astype(np.float64)
    near = _NEAR * float(np.ptp(points, axis=0).max(initial=0.0)) + 1e-12
    own = np.linalg.inv(np.array(obj.matrix_world, np.float64))
    index = np.array(stored["index"].to_list(), np.int64)
    candidates: list[tuple[int, Array, Array, _Seen | None]] = [
        (int(stored["count"]), index, np.array(stored["points"].to_list(), np.float64).reshape(-1, 3), None)
    ]
    for uid, seen in _seen.items():
        other = object_by_uid(uid)
        if uid != obj.session_uid and (other is None or not other.users_scene):
            to_own = own @ seen.matrix
            candidates.append((seen.count, seen.index, seen.points @ to_own[:3, :3].T + to_own[:3, 3], seen))
    parts: list[tuple[slice, _Seen | None]] = []
    first = 0
    while first < len(points):
        for candidate in candidates:
            count, index, places, seen = candidate
            if first + count <= len(points) and np.abs(points[first + index] - places).max(initial=0.0) <= near:
                parts.append((slice(first, first + count), seen))
                candidates.remove(candidate)
                first += count
                break
        else:
            break  # points of no splat object, or splats that were copied in Edit Mode
    return parts


def _mend_mark(mesh: ObjectData) -> None:
    """The degree of the harmonics is that of the richest part; points that were no splats are none to be seen."""
    degree = MAX_SH_DEGREE
    while degree and any(names.SH.format(k) not in mesh.attributes for k in range((degree + 1) ** 2 - 1)):
        degree -= 1
    mesh[names.MARK]["sh_degree"] = degree
    quats, scales, base = (read_attribute(mesh, name) for name in (names.ROTATION, names.SCALE, names.BASE))
    if quats is None or scales is None or base is None:
        return
    none = ~scales.any(axis=1)
    if none.any():
        # What Blender fills in differs from version to version; nothing is to be seen of them.
        quats[none], base[none, 3] = (1.0, 0.0, 0.0, 0.0), 0.0
        write_attribute(mesh, names.ROTATION, "QUATERNION", quats)
        write_attribute(mesh, names.BASE, "FLOAT_COLOR", base)


def _mend_records(obj: bpy.types.Object, parts: list[tuple[slice, _Seen | None]]) -> None:
    """What the meshes say beside their splats: hand work, confidence, what weights are compared with, file columns."""
    mesh: ObjectData = obj.data
    joined = [seen for _, seen in parts if seen is not None]
    if any(seen.edited for seen in joined):
        mark_edited(obj, True)
    record = None if names.COMPARED not in mesh else mesh[names.COMPARED].to_dict()
    if any(seen.compared != record for seen in joined):
        drop_kept(obj)
    values = read_attribute(mesh, names.CONFIDENCE)
    known = [seen is None or seen.sure for _, seen in parts]
    before = _seen.get(obj.session_uid)
    if values is not None:
        # Of splats about which nothing is known none is in doubt.
        for (rows, seen), sure in zip(parts, known, strict=True):
            if not sure or (seen is None and before is not None and not before.sure):
                values[rows] = 1.0
        write_attribute(mesh, names.CONFIDENCE, "FLOAT", values)
    mark: Any = mesh[names.MARK]
    columns = dict(_columns(str(mark.get("extra", "")), str(mark.get("types", ""))))
    for seen in joined:
        columns = {**dict(_columns(*seen.extra)), **columns}
    if columns:
        mark["extra"], mark["types"] = "\n".join(columns), "\n".join(columns.values())


def _columns(extra: str, types: str) -> list[tuple[str, str]]:
    found, kinds = [name for name in extra.split("\n") if name], types.split("\n")
    return [(name, kinds[place] if place < len(kinds) else "") for place, name in enumerate(found)]


# --- separated


def _remove_left_behind(obj: bpy.types.Object, part: bpy.types.Object) -> None:
    """Remove the splats of `obj`, in Edit Mode, that `part`, which was separated from it, has taken along."""
    stored, other = obj.data.get(names.PLACES), part.data.get(names.PLACES)
    if stored is None or other is None or stored.to_dict() != other.to_dict():
        return
    if not np.allclose(np.array(obj.matrix_world), np.array(part.matrix_world), atol=1e-6):
        return  # a copy, which remembers the same places
    mesh: ObjectData = obj.data
    work = bmesh.from_edit_mesh(mesh)
    here = np.array([vert.co[:] for vert in work.verts], np.float32).reshape(-1, 3)
    there = read_positions(part.data)
    rows = np.flatnonzero(np.isin(_keys(here), _keys(there)))
    layer, base = work.verts.layers.float_color.get(names.BASE), read_attribute(part.data, names.BASE)
    work.verts.ensure_lookup_table()
    if layer is not None and base is not None:
        # Two splats may lie in one place.
        taken = set(map(bytes, np.ascontiguousarray(np.concatenate([there, base], axis=1), np.float32)))
        values = np.array([tuple(work.verts[row][layer]) for row in rows.tolist()], np.float32).reshape(-1, 4)
        keys = map(bytes, np.ascontiguousarray(np.concatenate([here[rows], values], axis=1), np.float32))
        rows = rows[np.fromiter((key in taken for key in keys), np.bool_, len(rows))]
    if len(rows):
        bmesh.ops.delete(work, geom=[work.verts[row] for row in rows.tolist()], context="VERTS")
        bmesh.update_edit_mesh(mesh)


def _keys(points: Array) -> Array:
    return np.ascontiguousarray(points, np.float32).view([("", np.float32)] * 3).reshape(-1)


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, follow),
    (bpy.app.handlers.load_post, start_over),
)


def unregister() -> None:
    _seen.clear()
