# SPDX-License-Identifier: GPL-3.0-or-later
"""Armatures as skeletons: deform bones in world space, and their transforms in the current pose."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.bendy import BendyBone
from ..core.rig.skeleton import Skeleton
from .transforms import similarity_as_shown, world_similarity
from .visibility import shown

Array = NDArray[Any]


def deform_bones(armature: bpy.types.Object) -> list[bpy.types.Bone]:
    """The armature's deform bones, parents before children: the order of every array with a bone axis.

    Raises InputError: not an armature, no deform bones.
    """
    if armature is None or armature.type != "ARMATURE":
        raise InputError(f"'{getattr(armature, 'name', armature)}' is no armature; choose an armature object.")
    if armature.mode == "EDIT":
        armature.update_from_editmode()
    ordered: list[bpy.types.Bone] = []
    waiting = [bone for bone in reversed(armature.data.bones) if bone.parent is None]
    while waiting:
        bone = waiting.pop()
        ordered.append(bone)
        waiting.extend(reversed(bone.children))
    kept = [bone for bone in ordered if bone.use_deform]
    if not kept:
        raise InputError(
            f"Armature '{armature.name}' has no deform bones; "
            "turn on Deform (Bone Properties) for the bones that should move the splats."
        )
    return kept


def deform_bone_names(armature: bpy.types.Object) -> list[str]:
    """Names of `deform_bones`, in order."""
    return [bone.name for bone in deform_bones(armature)]


def read_skeleton(armature: bpy.types.Object) -> Skeleton:
    """The deform bones at rest, in world space with the armature object's transform applied (metres).

    A bone's parent is its nearest deforming ancestor. Raises InputError: no armature, no deform bones, bones of zero
    length, an object scale as `rig_similarity` refuses it.
    """
    bones = deform_bones(armature)
    rotation, scale, translation = rig_similarity(armature)
    index = {bone.name: place for place, bone in enumerate(bones)}
    parents = np.array([_deform_parent(bone, index) for bone in bones])
    rest = np.array([bone.matrix_local for bone in bones], dtype=np.float64)
    rest[:, :3, :3] = rotation @ rest[:, :3, :3]
    if scale < 0:
        rest[:, :3, :2] *= -1  # x and y as in the mirror; z, which makes it a rotation, the other way round
    heads = np.array([bone.head_local for bone in bones], dtype=np.float64) @ rotation.T * scale + translation
    tails = np.array([bone.tail_local for bone in bones], dtype=np.float64) @ rotation.T * scale + translation
    rest[:, :3, 3] = heads
    skeleton = Skeleton(tuple(index), parents, heads, tails, rest)
    skeleton.validate(f"armature '{armature.name}'")
    return skeleton


def rig_similarity(armature: bpy.types.Object, *, as_shown: bool = False) -> tuple[Array, float, Array]:
    """Rotation, scale (negative where it is mirrored) and translation of an armature, as `world_similarity`.

    The turn of a bone stays one in the mirror; segments and envelopes of bones are measured in the armature's own
    space, and that has to be like the world. as_shown: as of the last update. Raises InputError for uneven scale, and
    where both meet: mirrored, and bones with segments or multiplied envelopes.
    """
    bones: Any = getattr(armature.data, "bones", ())
    plain = not any(b.use_deform and (b.bbone_segments > 1 or b.use_envelope_multiply) for b in bones)
    read = similarity_as_shown if as_shown else world_similarity
    return read(armature, mirrored=plain)


def pose_transforms_of(armature: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> Array:
    """(B, 4, 4) float64 world-space deform transforms (pose x inverse(rest)) of the evaluated pose.

    Bones in the order of `read_skeleton`. They map points at rest, under the armature's present object transform, to
    posed points.
    """
    if depsgraph is None:
        with shown([armature]):
            return pose_transforms_of(armature, bpy.context.evaluated_depsgraph_get())
    evaluated = armature.evaluated_get(depsgraph)
    bones = deform_bones(armature)
    pose = np.array([evaluated.pose.bones[bone.name].matrix for bone in bones], dtype=np.float64)
    rest = np.array([bone.matrix_local for bone in bones], dtype=np.float64)
    world = np.array(evaluated.matrix_world, dtype=np.float64)
    return world @ pose @ np.linalg.inv(rest) @ np.linalg.inv(world)


def bends_of(
    armature: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None
) -> dict[int, BendyBone]:
    """The bendy ones among `deform_bones`, by their place, as they are in the evaluated pose."""
    depsgraph = depsgraph or bpy.context.evaluated_depsgraph_get()
    evaluated: Any = armature.evaluated_get(depsgraph)
    world = np.array(evaluated.matrix_world, dtype=np.float64)
    found = {}
    for place, bone in enumerate(deform_bones(armature)):
        if bone.bbone_segments < 2:
            continue
        posed = evaluated.pose.bones[bone.name]
        rest = np.array(bone.matrix_local, dtype=np.float64)
        steps = range(bone.bbone_segments + 1)
        now = np.array([posed.bbone_segment_matrix(index) for index in steps], dtype=np.float64)
        before = np.array([posed.bbone_segment_matrix(index, rest=True) for index in steps], dtype=np.float64)
        to_bone = np.linalg.inv(rest) @ np.linalg.inv(world)
        joints = world @ np.array(posed.matrix, dtype=np.float64) @ now @ np.linalg.inv(before) @ to_bone
        found[place] = BendyBone(joints, to_bone, float(bone.length))
    return found


def _deform_parent(bone: bpy.types.Bone, index: dict[str, int]) -> int:
    ancestor = bone.parent
    while ancestor is not None and ancestor.name not in index:
        ancestor = ancestor.parent
    return -1 if ancestor is None else index[ancestor.name]
