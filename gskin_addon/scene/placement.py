# SPDX-License-Identifier: GPL-3.0-or-later
"""Where splats stand: on the floor at the world's origin, and which of their axes points up.

Placing moves the object and leaves its data, so the file's own coordinates are never lost; how far it was moved is
kept on the object, to move it back or to bring a rig that was made for the file's coordinates. So is by how much a
reader has moved splats that lie far from the origin (`core/splats/georeference.py`).
"""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.job.checks import overlap
from ..core.rig.skeleton import Skeleton
from ..core.splats.axes import rotate_cloud, up_rotation
from ..core.splats.cloud import SplatCloud
from . import names
from .anchored import proxy_of
from .bone_frames import armature_of
from .rig_fit import move_rig
from .splat_object import read_cloud, replace_cloud

_OPAQUE = 0.3
_SAMPLES = 200_000
"""Splats that tell where the floor is: percentiles of more take longer and say the same."""


def floor_offset(cloud: SplatCloud) -> NDArray[np.float64]:
    """(3,) translation that stands the splats on z = 0 around the z axis; strays and faint splats do not count."""
    some = slice(None, None, max(1, cloud.count // _SAMPLES))
    points = cloud.means[some][cloud.opacities[some] >= _OPAQUE]
    low, high = np.percentile(points if len(points) else cloud.means[some], [0.5, 99.5], axis=0).astype(np.float64)
    return -np.array([*(low + high)[:2] / 2, low[2]])


def fits_where_it_is(cloud: SplatCloud, skeleton: Skeleton) -> bool:
    """Whether most bones lie within the splats, so that these must not be moved away from them."""
    return overlap(cloud.means[:: max(1, cloud.count // 50_000)].astype(np.float64), skeleton) >= 0.7


def fits_in_file(cloud: SplatCloud, skeleton: Skeleton) -> bool:
    """Whether the bones lie where a file far from the origin has its splats, not where they were moved to."""
    if not cloud.offset.any():
        return False
    points = cloud.means[:: max(1, cloud.count // 50_000)].astype(np.float64)
    return overlap(points, skeleton.moved(np.eye(3), translation=-cloud.offset)) > overlap(points, skeleton)


def place_on_floor(obj: bpy.types.Object, cloud: SplatCloud | None = None) -> None:
    """Move `obj` so that its splats stand on the floor at the origin. InputError where something carries it.

    cloud: what `read_cloud` would give, where it is at hand.
    """
    refuse_bound(obj)
    _move(obj, floor_offset(read_cloud(obj) if cloud is None else cloud))


def undo_placement(obj: bpy.types.Object) -> None:
    """Move `obj` back by what `place_on_floor` moved it. InputError where something carries it."""
    refuse_bound(obj)
    _move(obj, -offset_of(obj))


def offset_of(obj: bpy.types.Object) -> NDArray[np.float64]:
    """(3,) how far `obj` was moved from the file's coordinates; zeros where it was not."""
    return np.array(obj.get(names.OFFSET, (0.0, 0.0, 0.0)), dtype=np.float64)


def shift_of(obj: bpy.types.Object) -> NDArray[np.float64]:
    """(3,) how far the splats stand from the file's coordinates, in Blender's axes: placed, and moved when read."""
    return offset_of(obj) - np.array(obj.get(names.GEO_OFFSET, (0.0, 0.0, 0.0)), dtype=np.float64)


def as_in_file(obj: bpy.types.Object, cloud: SplatCloud, up: str = "") -> SplatCloud:
    """A cloud of `obj` in world space with the axes of a file: those of its own, or with `up` pointing up.

    Geo-referenced splats go back to where they belong even if they were placed on the floor.
    """
    if cloud.offset.any():
        cloud = replace(cloud, offset=cloud.offset - offset_of(obj))
    return rotate_cloud(cloud, up_rotation(up or up_of(obj)).T)


def bring_rig(armature: bpy.types.Object, step: NDArray[np.float64]) -> None:
    """Move an armature, or what carries it, by `step` (3,), with what moves its bones."""
    move_rig(armature, step)


def up_of(obj: bpy.types.Object) -> str:
    """The file's axis that points up in `obj`."""
    return str(obj.data[names.MARK].get("up", "z"))


def is_placed(obj: bpy.types.Object | None) -> bool:
    """Whether the splats stand elsewhere than their file has them."""
    return obj is not None and obj.get(names.OFFSET) is not None


def turn_up(obj: bpy.types.Object, up: str) -> None:
    """Let another of the file's axes point up: positions, rotations, spherical harmonics and normals turn.

    Splats that were placed are placed again. Raises InputError for an unknown axis, or where something carries them.
    """
    refuse_bound(obj)
    cloud = read_cloud(obj, world=False)
    R = up_rotation(up) @ up_rotation(up_of(obj)).T
    placed = is_placed(obj)
    if placed:
        undo_placement(obj)
    replace_cloud(obj, rotate_cloud(cloud, R))
    obj.data[names.MARK]["up"] = up
    if cloud.offset.any():
        obj[names.GEO_OFFSET] = (R @ cloud.offset).tolist()
    if placed:
        place_on_floor(obj)


def refuse_bound(obj: bpy.types.Object) -> None:
    """InputError where an armature, a proxy mesh or a parent carries `obj`."""
    carrier = armature_of(obj) or proxy_of(obj) or obj.parent
    if carrier is not None:
        raise InputError(f"'{obj.name}' follows '{carrier.name}'; move and turn '{carrier.name}' instead, or free it.")


def _move(obj: bpy.types.Object, step: NDArray[np.float64]) -> None:
    offset = offset_of(obj) + step
    obj.location = obj.location + Vector(step.tolist())
    if offset.any():
        obj[names.OFFSET] = offset.tolist()
    elif obj.get(names.OFFSET) is not None:
        del obj[names.OFFSET]
    bpy.context.view_layer.update()
