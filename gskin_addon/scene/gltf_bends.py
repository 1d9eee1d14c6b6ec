# SPDX-License-Identifier: GPL-3.0-or-later
"""Bendy bones as joints, while Blender's glTF exporter runs: glTF has bones of one matrix only.

A bone of n segments gets n + 1 children, one in the plane of every joint between segments, that copy what the joint
does; Blender's exporter samples them like any constrained bone. Splats follow two of them each, as Blender's Armature
modifier blends them. All of it happens on copies of armature and mesh, which go when the export is done.

Blender bends a stretched bone as if it were not, and stretches each segment along its own axes. So between the bone
and those children is one that takes the bone's scale away: what is left for each node is a rotation and a scale of its
axes, as glTF has it.

Where bones are sheared in the space of their parents (`gltf_shear.py`), as many of Rigify's are, splats follow free
stand-ins without a parent, and joints of bendy bones have none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import bpy
import mathutils
import numpy as np
from numpy.typing import NDArray

from ..core.rig.bendy import BendyBone
from .armature import bends_of, deform_bone_names
from .bone_frames import armature_of
from .deform_stack import bendy_bones
from .handlers import paused
from .splat_object import is_splat_object, read_cloud
from .vertex_groups import add_groups
from .weights import read_weights

Array = NDArray[Any]


def can_be_joints(armature: bpy.types.Object) -> bool:
    """Whether bones can be added to a copy of the armature's data: not so where the object is linked or overridden."""
    return armature.library is None and armature.override_library is None


@dataclasses.dataclass
class Made:
    """What stands in for bones while an export runs.

    most: the largest number of bones of a splat, 0 where nothing stands in. bones: name of each added bone that splats
    follow, and of the bone it stands in for.
    """

    most: int = 0
    bones: dict[str, str] = dataclasses.field(default_factory=dict)


@contextmanager
def bends_as_joints(
    objects: Sequence[bpy.types.Object], free: Mapping[str, Collection[str]] | None = None
) -> Iterator[Made]:
    """Inside the block the bendy bones that move these splats are chains of bones, and the splats follow those.

    free: for names of armatures the bones for which something without a parent shall stand in. The armatures must be
    in the view layer, evaluated and selectable.
    """
    free, made = free or {}, Made()
    splats = [obj for obj in objects if is_splat_object(obj)]
    rigs = [rig for rig in dict.fromkeys(armature_of(obj) for obj in splats) if rig is not None and can_be_joints(rig)]
    with ExitStack() as stack:
        for rig in rigs:
            followers = [obj for obj in splats if armature_of(obj) == rig]
            bends, alone = _wanted(rig, followers), set(free.get(rig.name, ()))
            if not bends and not alone:
                continue
            stack.enter_context(paused())
            order = deform_bone_names(rig)
            plain = [bone for bone in order if bone in alone and bone not in bends]
            others = [bone for bone in order if bone not in bends and bone not in alone]
            split = [(obj, *split_weights(obj, bends, plain)) for obj in followers]
            names = stack.enter_context(_with_joints(rig, bends, plain, alone))
            made.bones |= {name: bone for (bone, _), name in names.items()}
            for obj, weights, parts in split:
                counts = (weights > 0).sum(axis=1) + (read_weights(obj, others)[0] > 0).sum(axis=1)
                made.most = max(made.most, int(counts.max(initial=0)))
                joints = [names[part] for part in parts]
                stack.enter_context(_following(obj, [*bends, *plain], weights, joints))
        bpy.context.view_layer.update()
        yield made


@contextmanager
def idle_groups_aside(objects: Sequence[bpy.types.Object]) -> Iterator[None]:
    """Inside the block splats have no vertex groups of bones that do not deform: the exporter would follow these."""
    with ExitStack() as stack:
        for obj in objects:
            idle = idle_groups(obj) if is_splat_object(obj) else []
            if idle:
                stack.enter_context(paused())
                stack.enter_context(_following(obj, idle, np.zeros((len(obj.data.vertices), 0), np.float32), []))
        yield


def idle_groups(obj: bpy.types.Object) -> list[str]:
    """Vertex groups of the object that are named like bones of its armature which do not deform."""
    armature = armature_of(obj)
    bones = {} if armature is None else {bone.name: bone.use_deform for bone in armature.data.bones}
    return [group.name for group in obj.vertex_groups if not bones.get(group.name, True)]


def split_weights(
    obj: bpy.types.Object, bends: Mapping[str, BendyBone], plain: Sequence[str] = ()
) -> tuple[Array, list[tuple[str, int]]]:
    """Weights (N, K) of the joints of the bones `bends`, and which these are: name of the bone, number of the joint.

    The bones `plain` follow, as their own only joint.
    """
    points = read_cloud(obj).means.astype(np.float64)
    given, _ = read_weights(obj, [*bends, *plain])
    columns: list[Array] = []
    parts: list[tuple[str, int]] = []
    for weight, (name, bend) in zip(given.T, bends.items(), strict=False):
        first, share, _ = bend.place(points)
        for joint in range(bend.segments + 1):
            held = np.where(first == joint, 1 - share, np.where(first + 1 == joint, share, 0.0))
            columns.append((weight * held).astype(np.float32))
            parts.append((name, joint))
    columns += [*given.T[len(bends) :]]
    return np.stack(columns, axis=1), parts + [(name, 0) for name in plain]


def _wanted(rig: bpy.types.Object, followers: Sequence[bpy.types.Object]) -> dict[str, BendyBone]:
    """The bendy bones of the rig that move one of the splat objects, as they are now."""
    order, used = deform_bone_names(rig), {name for obj in followers for name in bendy_bones(obj)}
    return {order[place]: bend for place, bend in bends_of(rig).items() if order[place] in used}


@contextmanager
def _with_joints(
    rig: bpy.types.Object, bends: Mapping[str, BendyBone], plain: Sequence[str], free: Collection[str]
) -> Iterator[dict[tuple[str, int], str]]:
    """The rig has bones for the joints of its bendy bones, and for the bones `plain`; gives their names."""
    data: Any = rig.data
    copy = data.copy()
    name = data.name
    evaluated: Any = rig.evaluated_get(bpy.context.evaluated_depsgraph_get())
    rest: dict[str, list[Any]] = {
        bone: [evaluated.pose.bones[bone].bbone_segment_matrix(k, rest=True) for k in range(bend.segments + 1)]
        for bone, bend in bends.items()
    }
    rest |= {bone: [mathutils.Matrix()] for bone in plain}
    rig.data = copy
    _take_name(copy, data, name)
    try:
        names = _add_bones(rig, rest, free)
        for (bone, joint), added in names.items():
            copied: Any = rig.pose.bones[added].constraints.new("COPY_TRANSFORMS")
            copied.target, copied.subtarget = rig, bone
            if bone in bends:
                copied.head_tail, copied.use_bbone_shape = joint / bends[bone].segments, True
            unscaled: Any = rig.pose.bones[added].parent
            if unscaled is not None and not unscaled.constraints:
                taken: Any = unscaled.constraints.new("COPY_SCALE")
                taken.target, taken.subtarget, taken.power = rig, bone, -1
                taken.target_space, taken.owner_space = "POSE", "LOCAL"
        yield names
    finally:
        rig.data = data
        bpy.data.armatures.remove(copy)
        _give_back(data, name)


def _add_bones(
    rig: bpy.types.Object, rest: Mapping[str, list[Any]], free: Collection[str]
) -> dict[tuple[str, int], str]:
    """Add a bone for the scale to take away, and below it the joints, for every bone of `rest`; the joints' names.

    Those of the bones `free` have no parent.
    """
    layer = bpy.context.view_layer
    layer.objects.active = rig
    if rig.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.object.mode_set(mode="EDIT")
    made = {}
    try:
        for name, steps in rest.items():
            bone = rig.data.edit_bones[name]
            length = bone.length / max(1, len(steps) - 1)
            parent = None if name in free else _child(rig, f"{name}.bend", bone, bone.matrix, bone.length)
            for joint, step in enumerate(steps):
                made[name, joint] = _child(rig, f"{name}.bend{joint}", parent, bone.matrix @ step, length)
        # Blender may have changed a name that was too long or taken; bones of Edit Mode do not outlive it.
        names = {key: bone.name for key, bone in made.items()}
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
    return names


def _child(rig: bpy.types.Object, name: str, parent: Any, matrix: Any, length: float) -> Any:
    data: Any = rig.data
    bone = data.edit_bones.new(name)
    bone.parent, bone.use_connect, bone.use_deform, bone.bbone_segments = parent, False, True, 1
    bone.head, bone.tail = (0, 0, 0), (0, length, 0)
    bone.matrix = matrix
    bone.length = length
    return bone


@contextmanager
def _following(
    obj: bpy.types.Object, bones: Sequence[str], weights: Array, joints: Sequence[str]
) -> Iterator[None]:
    """The splats follow the joints of bendy bones, and these themselves no more."""
    data: Any = obj.data
    mesh = data.copy()
    name = data.name
    obj.data = mesh
    _take_name(mesh, data, name)
    try:
        for group in [group for group in obj.vertex_groups if group.name in bones]:
            obj.vertex_groups.remove(group)
        add_groups(obj, joints, weights)
        yield
    finally:
        obj.data = data
        bpy.data.meshes.remove(mesh)
        _give_back(data, name)


def _take_name(copy: Any, data: Any, name: str) -> None:
    """Let the copy go into the file under the name of what it stands for; a linked one keeps its own beside it."""
    if data.library is None:
        data.name = f"{name} (GSkin Export)"
    copy.name = name


def _give_back(data: Any, name: str) -> None:
    if data.library is None:
        data.name = name
