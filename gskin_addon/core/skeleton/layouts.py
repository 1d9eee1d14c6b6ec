# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones between joints: a person and a quadruped with the bones of Rigify's basic metarigs, a bird with its main ones.

Names and parents are Rigify's, so that its buttons make a control rig of the fitted bones; where the bones lie is ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.skeleton import Skeleton

Array = NDArray[Any]

Points = Mapping[str, Array]


@dataclass(frozen=True)
class Bone:
    """name, parent: `*` stands for L and R. head, tail: a point, or `a>b:0.3`, three tenths of the way from point a
    to point b. deform: whether splats may follow it."""

    name: str
    parent: str
    head: str
    tail: str
    deform: bool = True


_LEG = (
    Bone("thigh.*", "spine", "thigh.*", "knee.*"),
    Bone("shin.*", "thigh.*", "knee.*", "ankle.*"),
    Bone("foot.*", "shin.*", "ankle.*", "toe.*"),
    Bone("toe.*", "foot.*", "toe.*", "toe_tip.*"),
    Bone("heel.02.*", "foot.*", "heel_inner.*", "heel_outer.*", deform=False),
)

HUMAN = (
    Bone("spine", "", "hips", "hips>neck:0.24"),
    Bone("spine.001", "spine", "hips>neck:0.24", "hips>neck:0.46"),
    Bone("spine.002", "spine.001", "hips>neck:0.46", "hips>neck:0.7"),
    Bone("spine.003", "spine.002", "hips>neck:0.7", "neck"),
    Bone("spine.004", "spine.003", "neck", "neck>head:0.5"),
    Bone("spine.005", "spine.004", "neck>head:0.5", "head"),
    Bone("spine.006", "spine.005", "head", "crown"),
    Bone("shoulder.*", "spine.003", "collar>shoulder.*:0.12", "collar>shoulder.*:0.9"),
    Bone("upper_arm.*", "shoulder.*", "shoulder.*", "elbow.*"),
    Bone("forearm.*", "upper_arm.*", "elbow.*", "wrist.*"),
    Bone("hand.*", "forearm.*", "wrist.*", "wrist.*>fingers.*:0.6"),
    Bone("breast.*", "spine.003", "breast.*", "nipple.*", deform=False),
    Bone("pelvis.*", "spine", "hips", "hip_bone.*", deform=False),
    *_LEG,
)

QUADRUPED = (
    Bone("spine.004", "", "hips", "hips>neck:0.14"),
    Bone("spine.003", "spine.004", "hips", "tail"),
    Bone("spine.002", "spine.003", "tail", "tail>tail_tip:0.33"),
    Bone("spine.001", "spine.002", "tail>tail_tip:0.33", "tail>tail_tip:0.67"),
    Bone("spine", "spine.001", "tail>tail_tip:0.67", "tail_tip"),
    Bone("spine.005", "spine.004", "hips>neck:0.14", "hips>neck:0.34"),
    Bone("spine.006", "spine.005", "hips>neck:0.34", "hips>neck:0.54"),
    Bone("spine.007", "spine.006", "hips>neck:0.54", "hips>neck:0.74"),
    Bone("spine.008", "spine.007", "hips>neck:0.74", "neck"),
    Bone("spine.009", "spine.008", "neck", "neck>head:0.5"),
    Bone("spine.010", "spine.009", "neck>head:0.5", "head"),
    Bone("spine.011", "spine.010", "head", "muzzle"),
    Bone("shoulder.*", "spine.008", "blade.*", "blade.*>front_thigh.*:0.9"),
    Bone("front_thigh.*", "shoulder.*", "front_thigh.*", "front_shin.*"),
    Bone("front_shin.*", "front_thigh.*", "front_shin.*", "front_foot.*"),
    Bone("front_foot.*", "front_shin.*", "front_foot.*", "front_toe.*"),
    Bone("front_toe.*", "front_foot.*", "front_toe.*", "front_toe_tip.*"),
    Bone("breast.*", "spine.008", "breast.*", "nipple.*", deform=False),
    Bone("pelvis.*", "spine.005", "hips", "hip_bone.*", deform=False),
    Bone("thigh.*", "spine.005", "thigh.*", "shin.*"),
    Bone("shin.*", "thigh.*", "shin.*", "foot.*"),
    Bone("foot.*", "shin.*", "foot.*", "toe.*"),
    Bone("toe.*", "foot.*", "toe.*", "toe_tip.*"),
)

BIRD = (
    Bone("spine.003", "", "hips", "hips>neck:0.25"),
    Bone("spine.002", "spine.003", "hips", "tail"),
    Bone("spine.001", "spine.002", "tail", "tail>tail_tip:0.5"),
    Bone("spine", "spine.001", "tail>tail_tip:0.5", "tail_tip"),
    Bone("spine.004", "spine.003", "hips>neck:0.25", "hips>neck:0.5"),
    Bone("spine.005", "spine.004", "hips>neck:0.5", "hips>neck:0.75"),
    Bone("shoulder.*", "spine.005", "hips>neck:0.75", "hips>neck:0.75>wing.*:0.8"),
    Bone("Wing.*", "shoulder.*", "wing.*", "wing_elbow.*"),
    Bone("Wing.001.*", "Wing.*", "wing_elbow.*", "wing_wrist.*"),
    Bone("Wing.002.*", "Wing.001.*", "wing_wrist.*", "wing_tip.*"),
    Bone("spine.006", "spine.005", "hips>neck:0.75", "neck"),
    Bone("neck.001", "spine.006", "neck", "neck>head:0.5"),
    Bone("neck.002", "neck.001", "neck>head:0.5", "head"),
    Bone("head", "neck.002", "head", "beak"),
    Bone("pelvis.*", "spine.004", "hips", "hip_bone.*", deform=False),
    Bone("thigh.*", "spine.004", "thigh.*", "shin.*"),
    Bone("shin.*", "thigh.*", "shin.*", "foot.*"),
    Bone("foot.*", "shin.*", "foot.*", "toe.*"),
    Bone("toe.*", "foot.*", "toe.*", "toe_tip.*"),
)


def build(bones: tuple[Bone, ...], points: Points) -> tuple[Skeleton, Array]:
    """The skeleton of a table of bones between points, parents first, and (B,) bool which of its bones deform."""
    expanded = [_sided(bone, side) for bone in bones for side in ("LR" if "*" in bone.name else " ")]
    rank = {bone.name: number for number, bone in enumerate(expanded)}
    parents = [rank[bone.parent] if bone.parent else -1 for bone in expanded]
    heads = np.array([_point(bone.head, points) for bone in expanded])
    tails = np.array([_point(bone.tail, points) for bone in expanded])
    size = float(np.ptp(np.concatenate([heads, tails]), axis=0).max())
    short = np.linalg.norm(tails - heads, axis=1) < 5e-3 * size
    tails[short] = heads[short] + np.array([0.0, 0.0, 0.01 * size])  # Blender deletes bones without length
    skeleton = Skeleton(tuple(rank), np.array(parents), heads, tails)
    return skeleton, np.array([bone.deform for bone in expanded])


def _sided(bone: Bone, side: str) -> Bone:
    name, parent, head, tail = (text.replace("*", side) for text in (bone.name, bone.parent, bone.head, bone.tail))
    return Bone(name, parent, head, tail, bone.deform)


def _point(text: str, points: Points) -> Array:
    """A point of the table: `a`, `a>b:0.3`, or a chain of these from the left."""
    first, *rest = text.split(">")
    name, _, share = first.partition(":")
    place = points[name]
    for step in rest:
        name, _, share = step.partition(":")
        place = place + float(share) * (points[name] - place)
    return np.asarray(place, np.float64)
