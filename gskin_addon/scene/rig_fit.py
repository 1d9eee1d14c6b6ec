# SPDX-License-Identifier: GPL-3.0-or-later
"""How a rig lies in splats, from a sample of them: quick enough for panels, which ask on every redraw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import mathutils
import numpy as np
from numpy.typing import NDArray

from ..core.rig.rig_scale import ScaleGuess, guess_scale
from ..core.rig.skeleton import Skeleton
from ..core.splats.cleanup import find_strays
from ..core.splats.cloud import SplatCloud
from . import names
from .actions import keys_place
from .attributes import ObjectData, read_attribute, read_positions
from .dependencies import is_animated, needed_objects
from .transforms import points_in_world

Array = NDArray[Any]

SAMPLE = 20_000
"""The most splats that are looked at."""

_GAP = 0.03
"""A sample is thinner than the splats: with the gap of `find_strays` its fringes would count as strays."""


@dataclass(frozen=True, eq=False)
class SplatSample:
    """points (n, 3) float64 in the object's own space, without strays; strays: their share of the splats, 0 to 1.

    reach: the largest extent of all splats, strays too; size: the median standard deviation of a splat; both metres
    in the object's own space.
    """

    points: Array
    strays: float
    reach: float
    size: float


def sample_splats(obj: bpy.types.Object) -> SplatSample:
    """At most `SAMPLE` evenly picked splats of a splat object with at least two, at rest."""
    points = read_positions(obj.data)
    reach = float(np.ptp(points, axis=0).max())
    scales = read_attribute(obj.data, names.SCALE)
    points = points[:: -(-len(points) // SAMPLE)]
    blank = np.zeros((len(points), 1, 3), np.float32)
    ones = np.ones((len(points), 4), np.float32)
    stray = find_strays(SplatCloud(points, ones / 2, ones[:, :3], ones[:, 0], blank), gap=_GAP)
    kept = points if stray.all() else points[~stray]
    size = 0.0 if scales is None else float(np.median(scales[:: max(1, len(scales) // SAMPLE)]))
    return SplatSample(kept.astype(np.float64), float(stray.mean()), reach, size)


def rest_skeleton(armature: bpy.types.Object) -> Skeleton:
    """The deform bones at rest in the world, as of the last update; without rest rotations.

    Blender lists parents before their children.
    """
    data: ObjectData = armature.data
    bones = [bone for bone in data.bones if bone.use_deform]
    index = {bone.name: place for place, bone in enumerate(bones)}
    parents = [next((index[up.name] for up in bone.parent_recursive if up.name in index), -1) for bone in bones]
    ends = [points_in_world(np.array([getattr(b, end) for b in bones], np.float64).reshape(-1, 3), armature)
            for end in ("head_local", "tail_local")]  # fmt: skip
    return Skeleton(tuple(index), np.array(parents), *ends)


def box_of(points: Array) -> tuple[Array, Array]:
    """Lower and upper corner (3,) of the box of points (n, 3), without their outermost hundredth on each side."""
    lower, upper = np.percentile(points, [1, 99], axis=0)
    return lower, upper


def bone_box(skeleton: Skeleton) -> tuple[Array, Array]:
    """Lower and upper corner (3,) of the box of the bones."""
    ends = np.concatenate([skeleton.heads, skeleton.tails])
    return ends.min(axis=0), ends.max(axis=0)


def guess_rig_scale(points: Array, armature: bpy.types.Object) -> ScaleGuess:
    """Whether an armature is of another unit than splats at `points` (n, 3) in the world, as of the last update."""
    return guess_scale(points, rest_skeleton(armature), np.array(topmost(armature).matrix_world.translation))


def scale_rig(armature: bpy.types.Object, factor: float, *, about_world: bool = False) -> bpy.types.Object:
    """Scale an armature object, or what carries it, which is given, with what moves its bones.

    About its own origin, or with `about_world` about the world's.
    """
    pivot = mathutils.Vector() if about_world else topmost(armature).location.copy()
    top = _carrier(armature)
    for obj in (top, *_companions(armature)):
        obj.scale = obj.scale * factor
        obj.location = pivot + (obj.location - pivot) * factor
    bpy.context.view_layer.update()
    return top


def move_rig(armature: bpy.types.Object, step: Array) -> bpy.types.Object:
    """Move an armature object, or what carries it, which is given, by `step` (3,); what moves its bones goes along."""
    top = _carrier(armature)
    for obj in (top, *_companions(armature)):
        obj.location = obj.location + mathutils.Vector([float(value) for value in step])
    bpy.context.view_layer.update()
    return top


def place_rig(armature: bpy.types.Object, rotation: Array, scale: float, translation: Array) -> None:
    """Bring an armature object, or what carries it, by x -> scale * rotation @ x + translation to another place in the
    world; what moves its bones goes along."""
    rows = np.vstack([np.column_stack([scale * rotation, translation]), [0, 0, 0, 1]])
    move = mathutils.Matrix(rows.tolist())
    for obj in (_carrier(armature), *_companions(armature)):
        obj.matrix_world = move @ obj.matrix_world
    bpy.context.view_layer.update()


def _carrier(armature: bpy.types.Object) -> bpy.types.Object:
    """What must be moved or scaled to move or scale a rig: `topmost`, or where its place is animated, so that the next
    frame would undo it, an empty around that."""
    top = topmost(armature)
    return _framed(top) if keys_place(top) else top


def _framed(obj: bpy.types.Object) -> bpy.types.Object:
    """A new empty at the world's origin that carries `obj`, which has no parent."""
    frame = bpy.data.objects.new(f"{obj.name} Frame", None)
    for collection in obj.users_collection:
        collection.objects.link(frame)
    obj.parent, obj.matrix_parent_inverse = frame, mathutils.Matrix()
    bpy.context.view_layer.update()
    return frame


def _companions(armature: bpy.types.Object) -> list[bpy.types.Object]:
    """What else must be moved with a rig: targets and the like, or where they are animated an empty around them.

    Objects with constraints of their own go where these put them.
    """
    top = topmost(armature)
    found = []
    for obj in dict.fromkeys(topmost(needed) for needed in needed_objects(armature)):
        if obj == top or len(obj.constraints):
            continue
        if is_animated([obj]):
            obj = _framed(obj)
        found.append(obj)
    return found


def step_to_fit(points: Array, skeleton: Skeleton) -> Array:
    """(3,) translation that brings the bones into the splats at `points` (n, 3): middle over middle, feet on feet."""
    (low, high), (bottom, top) = box_of(points), bone_box(skeleton)
    step = np.asarray(((low + high) - (bottom + top)) / 2)
    if top[2] - bottom[2] > 0.5 * (high[2] - low[2]):  # a whole figure, which stands
        step[2] = low[2] - bottom[2]
    return step


def topmost(obj: bpy.types.Object) -> bpy.types.Object:
    """The object that carries `obj` and is carried by none: what must be moved or scaled to move or scale it."""
    while obj.parent is not None:
        obj = obj.parent
    return obj
