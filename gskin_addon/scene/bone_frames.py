# SPDX-License-Identifier: GPL-3.0-or-later
"""Bone frames: a helper mesh from which Geometry Nodes learns how the bones are turned.

Four vertices per deform bone (head, head + x, head + y, head + z, axes of the world), each fully weighted to its
bone, under the same Armature modifier as the splats. `rotation_nodes.py` reads the rotations off them; that works in
every Blender from 4.2 and with any constraint or driver, because it looks at what the modifier did.

A bendy bone has further frames, "joints": in the plane of every joint between its segments, where the modifier knows
one joint alone, an origin, x and z of the bone, and for y a point in the middle of the segment; and one frame beyond
its tail. `stretch_nodes.py` makes the map of a splat inside a segment from two joints.

The helper belongs to no collection: Blender evaluates it because the splats' modifier points to it, it is saved and
appended with them, and neither the outliner's scene view, nor renders, nor exporters see it. It has no parent either
(exporters follow children). One helper serves all splat objects of an armature.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.rig.quaternion import matrix_to_quat
from . import names
from .armature import deform_bone_names, deform_bones, read_skeleton
from .attributes import write_attribute, write_positions
from .helpers import hide_helper

Array = NDArray[Any]

VERSION = 2
"""Of the layout; frames of another one are made anew when the splats are bound or their weights are taken over."""


def ensure_bone_frames(armature: bpy.types.Object) -> bpy.types.Object:
    """The armature's helper for its present deform bones; made where there is none.

    Raises InputError as `read_skeleton` does.
    """
    return find_bone_frames(armature) or _create(armature)


def find_bone_frames(armature: bpy.types.Object) -> bpy.types.Object | None:
    """A helper that already follows the armature with the same deform bones in the same order."""
    bones = deform_bone_names(armature)
    for obj in bpy.data.objects:
        if not is_bone_frames(obj) or armature_of(obj) != armature or obj.library is not None:
            continue
        if bone_order(obj) == bones and not is_outdated(obj, armature):
            return obj
    return None


def layout_of(armature: bpy.types.Object) -> str:
    """What frames depend on beside the bones' names: bendy bones, and envelopes that multiply weights, at rest."""
    found: list[Any] = [VERSION]
    for bone in deform_bones(armature):
        if bone.bbone_segments > 1 or bone.use_envelope_multiply:
            place = np.round(np.array(bone.matrix_local), 5).tolist()
            envelope = _reach(bone) if bone.use_envelope_multiply else 0
            found.append((bone.name, bone.bbone_segments, bone.length, envelope, place))
    return str(found)


def is_bone_frames(obj: bpy.types.Object | None) -> bool:
    """Whether `obj` is such a helper, which is no object of the artist's."""
    return obj is not None and obj.type == "MESH" and obj.get(names.FRAMES_MARK) is not None


def is_outdated(frames: bpy.types.Object, armature: bpy.types.Object) -> bool:
    """Whether the helper was made for other bendy bones or envelopes than the armature has."""
    return frames.get(names.FRAMES_LAYOUT) != layout_of(armature)


def has_joints(frames: bpy.types.Object) -> bool:
    """Whether some of the helper's frames are joints of bendy bones."""
    return len(frames.data.vertices) > 4 * len(frames.vertex_groups)


def has_bendy_bones(armature: bpy.types.Object) -> bool:
    """Whether a helper for the armature has such joints."""
    return any(bone.bbone_segments > 1 for bone in deform_bones(armature))


def bone_order(frames: bpy.types.Object) -> list[str]:
    """Bone names by index. They are the helper's vertex groups, which Blender renames along with the bones."""
    return [group.name for group in frames.vertex_groups]


def armature_of(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The armature of the object's `armature_modifier`."""
    modifier = armature_modifier(obj)
    return None if modifier is None else modifier.object


def armature_modifier(obj: bpy.types.Object) -> bpy.types.ArmatureModifier | None:
    """The object's Armature modifier that has an armature: of several that of its parent, else the first.

    The first one at all where none has an armature.
    """
    found: list[Any] = [modifier for modifier in obj.modifiers if modifier.type == "ARMATURE"]
    live = [modifier for modifier in found if modifier.object is not None]
    own = [modifier for modifier in live if modifier.object == obj.parent] if len(live) > 1 else []
    return next(iter([*own, *live, *found]), None)


def _create(armature: bpy.types.Object) -> bpy.types.Object:
    skeleton, bones = read_skeleton(armature), deform_bones(armature)
    # Axes about as long as the skeleton: short ones would lose digits against the positions.
    size = float(np.ptp(np.concatenate([skeleton.heads, skeleton.tails]), axis=0).max())
    bent = any(bone.bbone_segments > 1 or bone.use_envelope_multiply for bone in bones)
    if bent:
        # Joints have their places in the armature, which may be moved: the frames go with it.
        size /= float(np.cbrt(np.linalg.det(np.array(armature.matrix_world)[:3, :3])))
        made = [_frame(bone, size) for bone in bones]
        for index, bone in enumerate(bones):
            if bone.bbone_segments > 1:
                made[index].first = len(made)
                made += _joints(bone, size)
    else:
        made = [_Frame(head, np.eye(3), size) for head in skeleton.heads]
    mesh = bpy.data.meshes.new(f"GSkin Bone Frames ({armature.name})")
    mesh.vertices.add(4 * len(made))
    write_positions(mesh, np.concatenate([frame.points() for frame in made]))
    _write_layout(mesh, made)
    frames = bpy.data.objects.new(mesh.name, mesh)
    frames[names.FRAMES_MARK] = True
    frames[names.FRAMES_LAYOUT] = layout_of(armature)
    hide_helper(frames)
    for index, bone in enumerate(bones):
        frame = made[index]
        own = [index, *(range(frame.first, frame.first + frame.segments + 2) if frame.segments else ())]
        corners = [4 * place + corner for place in own for corner in range(4)]
        frames.vertex_groups.new(name=bone.name).add(corners, 1.0, "REPLACE")
    modifier: Any = frames.modifiers.new(names.ARMATURE_MODIFIER, "ARMATURE")
    modifier.object = armature
    modifier.use_bone_envelopes = False
    if bent:
        constraint: Any = frames.constraints.new("COPY_TRANSFORMS")
        constraint.target = armature
    return frames


@dataclasses.dataclass
class _Frame:
    """Four points of the helper: `origin` (3,) and, `size` away along the columns of `axes` (3, 3), three more.

    segments, first, span: on the frame of a bendy bone and on its joints, how many segments it has, the place of its
    first joint among the frames, and the length of a segment. middle (3,): on a joint, in place of the point along y.
    """

    origin: Array
    axes: Array
    size: float
    segments: int = 0
    first: int = -1
    span: float = 1.0
    middle: Array | None = None

    @property
    def kind(self) -> float:
        """0: its four points are moved alike; 1: a joint with a segment behind it; 2: the last joint of its bone."""
        if self.middle is None:
            return 0.0
        return 1.0 if (self.middle != self.origin).any() else 2.0

    def points(self) -> Array:
        """(4, 3)."""
        found = self.origin + np.concatenate([np.zeros((1, 3)), self.axes.T * self.size])
        if self.middle is not None:
            found[2] = self.middle
        return found


def _reach(bone: bpy.types.Bone) -> float:
    """How far from its head the bone's envelope surely still counts."""
    return 0.5 * float(bone.envelope_distance or bone.head_radius)


def _frame(bone: bpy.types.Bone, size: float) -> _Frame:
    rest = np.array(bone.matrix_local, dtype=np.float64)
    if bone.use_envelope_multiply:
        size = min(size, _reach(bone))
    if bone.bbone_segments < 2:
        return _Frame(rest[:3, 3], np.eye(3), size)
    # In front of its head, where only the first joint counts: y and z are turned round.
    segments = bone.bbone_segments
    return _Frame(rest[:3, 3], rest[:3, :3] * [1, -1, -1], size, segments, span=bone.length / segments)


def _joints(bone: bpy.types.Bone, size: float) -> list[_Frame]:
    rest = np.array(bone.matrix_local, dtype=np.float64)
    axes, segments = rest[:3, :3], bone.bbone_segments
    if bone.use_envelope_multiply:
        size = min(size, _reach(bone))
    span = bone.length / segments
    found = []
    for index in range(segments + 1):
        origin = rest[:3, 3] + axes[:, 1] * span * index
        middle = origin + axes[:, 1] * span / 2 * (index < segments)
        found.append(_Frame(origin, axes, size, segments, span=span, middle=middle))
    return [*found, _Frame(found[-1].origin, axes, size)]


def _write_layout(mesh: bpy.types.Mesh, made: list[_Frame]) -> None:
    """The frames at rest as attributes on their points, for the nodes."""
    for name, kind, values in (
        (names.FRAME_AXES, "QUATERNION", matrix_to_quat(np.array([frame.axes for frame in made]))),
        (names.FRAME_ORIGIN, "FLOAT_VECTOR", np.array([frame.origin for frame in made])),
        (names.FRAME_SIZE, "FLOAT", np.array([frame.size for frame in made])),
        (names.FRAME_BEND, "FLOAT_VECTOR", np.array([(f.first, f.segments, f.span) for f in made])),
        (names.FRAME_JOINT, "FLOAT", np.array([frame.kind for frame in made])),
    ):
        write_attribute(mesh, name, kind, np.repeat(values, 4, axis=0))
