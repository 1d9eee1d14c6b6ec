# SPDX-License-Identifier: GPL-3.0-or-later
"""The joints that a fit looks for, and which bones of an artist's rig begin at them, told from their names.

A joint is where a bone begins: `knee.L` is the head of the left lower leg.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.bone_roles import ROLES, bone_roles
from ..rig.mirror import mirrored_name, side_of_name
from ..rig.skeleton import Skeleton

Array = NDArray[Any]

HUMAN = ("hips", "neck", "head", "shoulder", "elbow", "wrist", "thigh", "knee", "ankle", "toe")
"""Joints of a person: those of the middle once, of the limbs on the left; the right side has the same."""

QUADRUPED = (
    "hips", "neck", "head", "tail", "front_thigh", "front_foot", "front_toe", "thigh", "shin", "foot", "toe",
)  # fmt: skip
"""Joints of a four-legged animal: `neck` where the neck leaves the trunk, `tail` where the tail begins; a front leg
begins at front_thigh, bends at front_foot (carpus) and meets its toes at front_toe; a hind leg bends at shin (stifle)
and foot (hock)."""

MIDDLE = ("hips", "neck", "head", "tail", "crown", "beak", "tail_tip")


def both_sides(joints: Sequence[str]) -> tuple[str, ...]:
    """Names of all joints: `hips`, ..., `knee.L`, `knee.R`, ..."""
    middle = [name for name in joints if name in MIDDLE]
    return (*middle, *(f"{name}.{side}" for name in joints if name not in MIDDLE for side in "LR"))


def human_bones(skeleton: Skeleton, used: Array | None = None) -> dict[str, int]:
    """The bone that begins at each of those of `both_sides(HUMAN)` that the names of a person's bones tell.

    used (B,) bool: the bones that carry weights, where that is known; they go before others of the same name.
    """
    rig = _Rig(skeleton, used)
    found: dict[str, int] = {}
    for side in "LR":
        _arm(rig, side, found)
        _leg(rig, side, found)
    head = rig.find("head", "")
    if head:
        found["head"] = head[0]
        neck = [bone for bone in rig.find("neck", "") if bone in rig.ancestors(head[0])]
        if neck:
            found["neck"] = neck[0]
    corners = [found.get(name) for name in ("thigh.L", "thigh.R", "shoulder.L", "shoulder.R")]
    if all(bone is not None for bone in corners):
        places = skeleton.heads[np.array(corners)]
        legs, arms = places[:2].mean(axis=0), places[2:].mean(axis=0)
        up = arms - legs
        height = (skeleton.heads - legs) @ up / max(float(up @ up), 1e-30)
        trunk = [bone for bone in rig.find(("hips", "spine", "body", "chest"), "") if abs(height[bone]) < 0.3]
        if trunk:
            found["hips"] = trunk[0]
    return found


_QUADRUPEDS: tuple[tuple[str, ...], ...] = (
    # In the order of `both_sides(QUADRUPED)`, of the left side; "" where a rig has no such joint.
    ("Back", "Neck1", "Head", "Tail1", "FrontUpperLeg.L", "FrontLowerLeg.L", "IKFrontLeg.L", "BackLeg.L",
     "BackUpperLeg.L", "BackLowerLeg.L", "IKBackLeg.L"),
    ("Back", "Neck", "Head", "", "FrontUpLeg.L", "FrontLowLeg.L", "FrontFoot.L", "BackUpLeg.L", "", "BackLowLeg.L",
     "BackFoot.L"),
    ("Pelvis", "NeckBase", "Head", "Pelvis.002", "ForeThigh.L", "ForeCalf.L", "ForeFoot.L", "BackThigh.L",
     "BackLowerThigh.L", "BackCalf.L", "BackFoot.L"),
    ("Hip", "Backbone.001", "Head", "Tail", "FrontLeg_L", "FrontLeg_L.001", "FrontLeg_L.002", "BackLeg_L",
     "BackLeg_L.001", "BackLeg_L.002", "BackLeg_L.003"),
)  # fmt: skip
"""Names that rigs of quadrupeds have for the joints."""

_NUMBERED = (
    ("Bone", "", "Bone.003", "Bone.004", "Bone.017", "Bone.018", "Bone.019", "Bone.008", "", "Bone.009", "Bone.010"),
    ("Bone", "", "Bone.003", "Bone.004", "Bone.014", "Bone.015", "Bone.016", "Bone.011", "", "Bone.012", "Bone.013"),
)
"""A rig of numbered bones, left and right; it is told by its names of targets."""


def quadruped_bones(skeleton: Skeleton) -> dict[str, int]:
    """The bone that begins at each of `both_sides(QUADRUPED)`, for rigs whose names are known; else none."""
    place = {name: number for number, name in enumerate(skeleton.names)}
    pairs = [(left, tuple(mirrored_name(name) for name in left)) for left in _QUADRUPEDS]
    if "IKFrontLeft" in place:
        pairs.append((_NUMBERED[0], _NUMBERED[1]))
    for left, right in pairs:
        if all(name in place for name in (*left, *right) if name):
            found = {}
            for joint, one, other in zip(QUADRUPED, left, right, strict=True):
                if joint in MIDDLE and one:
                    found[joint] = place[one]
                elif one:
                    found[f"{joint}.L"], found[f"{joint}.R"] = place[one], place[other]
            if "tail" not in found and "Tail1" in place:
                found["tail"] = place["Tail1"]
            return found
    return {}


def joints_of(skeleton: Skeleton, bones: dict[str, int]) -> dict[str, Array]:
    """Where (3,) the bones begin that `human_bones` and the like found."""
    return {name: skeleton.heads[bone] for name, bone in bones.items()}


def facing(joints: dict[str, Array]) -> Array | None:
    """Unit vector (3,) in the plane of the floor to where a body with these joints looks; None where no pair tells."""
    pairs = [
        joints[f"{name}.L"] - joints[f"{name}.R"]
        for name in ("thigh", "shoulder", "knee", "elbow", "front_thigh", "shin")
        if f"{name}.L" in joints and f"{name}.R" in joints
    ]
    left = np.sum(pairs, axis=0) if pairs else np.zeros(3)
    front = np.array([left[1], -left[0], 0.0])  # left is +x where the body looks along -y
    length = float(np.linalg.norm(front))
    return front / length if length > 0 else None


class _Rig:
    """Roles, sides and kin of a skeleton's bones."""

    def __init__(self, skeleton: Skeleton, used: Array | None) -> None:
        self.skeleton = skeleton
        self.used = np.ones(skeleton.count, bool) if used is None else np.asarray(used, bool)
        self.roles = [ROLES[role] for role in bone_roles(skeleton.names)]
        self.sides = [side_of_name(name)[:1].upper() for name in skeleton.names]

    def ancestors(self, bone: int) -> list[int]:
        """A bone, its parent, and so on."""
        found = []
        while bone >= 0:
            found.append(bone)
            bone = int(self.skeleton.parents[bone])
        return found

    def find(self, roles: str | Sequence[str], side: str, below: int | None = None) -> list[int]:
        """Bones of one of the roles and a side, used ones and those nearest to the root first; `below` another."""
        wanted = {roles} if isinstance(roles, str) else set(roles)
        found = [bone for bone, role in enumerate(self.roles) if role in wanted and self.sides[bone] == side]
        if below is not None:
            found = [bone for bone in found if below in self.ancestors(bone)]
        return sorted(found, key=lambda bone: (not self.used[bone], len(self.ancestors(bone))))


def _arm(rig: _Rig, side: str, found: dict[str, int]) -> None:
    lower = rig.find("lower arm", side)
    if not lower:
        return
    found[f"elbow.{side}"] = lower[0]
    upper = [bone for bone in rig.ancestors(lower[0])[1:] if rig.roles[bone] in ("upper arm", "arm", "shoulder")]
    if upper:
        found[f"shoulder.{side}"] = upper[0]
    hand = rig.find("hand", side, lower[0])
    if hand:
        found[f"wrist.{side}"] = hand[0]


def _leg(rig: _Rig, side: str, found: dict[str, int]) -> None:
    parents = rig.skeleton.parents
    shin = rig.find("lower leg", side)
    if not shin:  # LeftUpLeg, LeftLeg
        shin = [bone for bone in rig.find("leg", side) if rig.roles[int(parents[bone])] == "upper leg"]
    if not shin:
        return
    found[f"knee.{side}"] = shin[0]
    thigh = [bone for bone in rig.ancestors(shin[0])[1:2] if rig.roles[bone] in ("upper leg", "leg")]
    if thigh:
        found[f"thigh.{side}"] = thigh[0]
    foot = rig.find("foot", side, shin[0]) or rig.find("foot", side)  # where feet follow targets, they hang on the root
    if foot:
        found[f"ankle.{side}"] = foot[0]
        toe = rig.find("toe", side, foot[0])
        if toe:
            found[f"toe.{side}"] = toe[0]
