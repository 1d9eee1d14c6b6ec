# SPDX-License-Identifier: GPL-3.0-or-later
"""Which control to use for a bone that cannot be turned by itself, as Rigify's DEF- bones cannot.

What a bone follows is found by walking constraints, drivers and parents; which of those bones turns it as wanted is
found by trying.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import bpy
import mathutils

from .dependencies import driver_targets, pointed_objects

MISS = 0.3
"""Part of the asked angle by which a control may turn a bone otherwise, as twist that is spread over a limb does."""
_TRIED, _NEAR = 32, 6
"""The most controls that are tried, the nearest first: for the best one, and for one that is near."""

_AT_JOINT = 0.05
"""Part of a bone's length by which a control that sits at its joint may be off."""

INNER = ("DEF-", "ORG-", "MCH-")
"""What rigs call bones that no artist is to touch."""


@dataclass(frozen=True)
class Control:
    """A bone to turn instead; owner, prop, value: the custom property that must be set first, "" where none."""

    bone: str
    owner: str = ""
    prop: str = ""
    value: float = 0.0

    def __str__(self) -> str:
        words = f"turn '{self.bone}' instead"
        if not self.prop:
            return words
        given = f"{self.value:g}"
        switch = f"'{self.prop}' of '{self.owner}' to {given} (--set {self.owner} {self.prop} {given})"
        return f"{words}, after setting {switch}"


def find_control(
    armature: bpy.types.Object, bone: str, turn: Callable[[str], None], restore: Callable[[], None]
) -> Control | None:
    """The control that turns `bone` as turn(bone) would if the bone were free, and the fewest others; None if none.

    turn turns a bone by its name, as wanted; restore takes all turns back. The rig's pose must be at rest from turns.
    """
    chosen: tuple[float, Control] | None = None
    # What only shifts a part of a limb is no control of the bone.
    candidates = [name for name in controls(armature, bone) if "tweak" not in name][:_TRIED]
    with without_followers(armature):
        found = _best(armature, bone, candidates, turn, restore)
        if found is not None:
            chosen = found[0], Control(found[1])
        for owner, prop in switches(armature, [bone, *sources(armature, bone)]):
            with switched(armature, owner, prop) as value:
                found = _best(armature, bone, candidates, turn, restore)
            # Something has to be set first: worth it where it spares other bones.
            if found is not None and (chosen is None or found[0] < 0.7 * chosen[0]):
                chosen = found[0], Control(found[1], owner, prop, value)
    return None if chosen is None else chosen[1]


def near_control(
    armature: bpy.types.Object, bone: str, turn: Callable[[str], None], restore: Callable[[], None]
) -> Control | None:
    """The first of the nearest controls that turns `bone` as asked, where every bone of a rig is looked at and the best
    one (`find_control`) would take too long. turn, restore: as there, restore without an update; the rig must be in its
    rest pose."""
    bones = armature.data.bones
    near = bones[bone].length * _AT_JOINT
    found = [name for name in controls(armature, bone) if "tweak" not in name]
    # What turns a bone about its joint mostly sits there.
    at_joint = [name for name in found if (bones[name].head_local - bones[bone].head_local).length <= near]
    candidates = (at_joint or found)[:_NEAR]
    switch = switches(armature, [bone, *sources(armature, bone)])[:_NEAR]
    own = armature.pose.bones[bone].matrix_basis.to_quaternion()
    with without_followers(armature):
        before = _matrix(armature, bone)
        turn(bone)
        asked = own.inverted() @ armature.pose.bones[bone].matrix_basis.to_quaternion()
        restore()

        def first() -> str | None:
            for name in candidates:
                turn(name)
                after = _matrix(armature, bone)
                restore()
                stays = (after.translation - before.translation).length <= near  # the whole rig's root turns it, too
                turned = _angle(before.to_quaternion() @ asked, after.to_quaternion())
                if stays and turned <= MISS * max(asked.angle, 1e-6):
                    return name
            return None

        name = first()
        if name is not None:
            return Control(name)
        for owner, prop in switch:
            with switched(armature, owner, prop) as value:
                name = first()
            if name is not None:
                return Control(name, owner, prop, value)
    return None


def sources(armature: bpy.types.Object, bone: str) -> list[str]:
    """Bones of the same armature that may move `bone`, the nearest first."""
    chains = _ik_chains(armature)
    found, waiting = [bone], [bone]
    while waiting:
        name = waiting.pop(0)
        for other in _direct(armature, name, chains):
            if other not in found:
                found.append(other)
                waiting.append(other)
    return found[1:]


def controls(armature: bpy.types.Object, bone: str) -> list[str]:
    """Bones of the same armature that a bone follows and that artists touch, the nearest first; not its parents."""
    parents = {parent.name for parent in armature.pose.bones[bone].parent_recursive}
    return [name for name in sources(armature, bone) if name not in parents and not name.startswith(INNER)]


def outer_sources(armature: bpy.types.Object, bone: str) -> list[str]:
    """Names of other objects that hold a bone by its constraints, its drivers or an IK chain through it."""
    holders = [armature.pose.bones[bone], *_ik_chains(armature).get(bone, [])]
    found = [obj for holder in holders for c in holder.constraints for obj in pointed_objects(c)]
    found += [ident for ident, _ in _driver_targets(armature, bone) if isinstance(ident, bpy.types.Object)]
    return list(dict.fromkeys(obj.name for obj in found if obj != armature))


def why_held(armature: bpy.types.Object, bone: str) -> str:
    """What keeps a bone from turning, to follow "its rotation ..."; empty where nothing is found."""
    holder = armature.pose.bones[bone]
    driven = [d for d in _drivers_of(armature, bone) if ".rotation_" in d.data_path and not d.mute]
    if driven:
        return "is driven"
    active = [c.name for c in holder.constraints if c.enabled and c.influence > 0]
    if active:
        return "is held by its constraint " + ", ".join(f"'{name}'" for name in active)
    chain = _ik_chains(armature).get(bone, [])
    if chain:
        return "is solved by the IK of " + ", ".join(f"'{end.name}'" for end in chain)
    return ""


def switches(armature: bpy.types.Object, bones: Iterable[str]) -> list[tuple[str, str]]:
    """Custom properties (bone, name) between 0 and 1 that drive how much the bones' constraints count."""
    found: dict[tuple[str, str], None] = {}
    for bone in bones:
        for fcurve in _drivers_of(armature, bone):
            if ".constraints[" not in fcurve.data_path:
                continue
            for ident, path in driver_targets(fcurve):
                owner, prop = _bone_property(path)
                if ident == armature and owner in armature.pose.bones:
                    value: Any = armature.pose.bones[owner].get(prop)
                    if isinstance(value, (int, float)) and 0 <= value <= 1:
                        found[owner, prop] = None
    return list(found)


def followers(armature: bpy.types.Object, bone: str) -> list[str]:
    """Bones of the same armature that constraints, drivers or parents let follow `bone`, switched on or not."""
    chains = _ik_chains(armature)
    direct: dict[str, list[str]] = {}
    for other in armature.pose.bones:
        for source in _direct(armature, other.name, chains):
            direct.setdefault(source, []).append(other.name)
    found = [bone]
    for name in found:
        found += [other for other in dict.fromkeys(direct.get(name, ())) if other not in found]
    return found[1:]


@contextmanager
def switched(armature: bpy.types.Object, owner: str, prop: str) -> Iterator[float]:
    """Inside the block a custom property between 0 and 1 has the other value, which the block is given."""
    holder: Any = armature.pose.bones[owner]
    before = holder[prop]
    other = type(before)(0 if before >= 0.5 else 1)
    try:
        _set(armature, owner, prop, other)
        yield float(other)
    finally:
        _set(armature, owner, prop, before)


def set_property(armature: bpy.types.Object, owner: str, prop: str, value: float) -> None:
    """Set a custom property of a pose bone, of the type that it has; the rig is evaluated anew."""
    holder: Any = armature.pose.bones[owner]
    _set(armature, owner, prop, type(holder[prop])(value))


def _set(armature: bpy.types.Object, owner: str, prop: str, value: Any) -> None:
    holder: Any = armature.pose.bones[owner]
    holder[prop] = value
    armature.update_tag()
    bpy.context.view_layer.update()


def _direct(armature: bpy.types.Object, bone: str, chains: dict[str, list[bpy.types.PoseBone]]) -> Iterator[str]:
    holder = armature.pose.bones[bone]
    for constrained in [holder, *chains.get(bone, [])]:
        for constraint in constrained.constraints:
            yield from _bones_of_constraint(armature, constraint)
    for ident, path in _driver_targets(armature, bone):
        owner = path if path in armature.pose.bones else _bone_property(path)[0]
        if ident == armature and owner in armature.pose.bones:
            yield owner
    if holder.parent is not None:
        yield holder.parent.name


def _bones_of_constraint(armature: bpy.types.Object, constraint: Any) -> Iterator[str]:
    pairs = [("target", "subtarget"), ("pole_target", "pole_subtarget")]
    holders = [(constraint, *pair) for pair in pairs]
    holders += [(target, "target", "subtarget") for target in getattr(constraint, "targets", ())]
    for holder, target, sub in holders:
        name = getattr(holder, sub, "")
        if getattr(holder, target, None) == armature and name in armature.pose.bones:
            yield name


def _ik_chains(armature: bpy.types.Object) -> dict[str, list[bpy.types.PoseBone]]:
    """For each bone the bones whose IK solves it, besides its own."""
    chains: dict[str, list[bpy.types.PoseBone]] = {}
    for end in armature.pose.bones:
        for constraint in end.constraints:
            if constraint.type in {"IK", "SPLINE_IK"} and constraint.enabled and constraint.influence > 0:
                link, count = end, 1
                limit: Any = constraint
                while link.parent is not None and (count < limit.chain_count or limit.chain_count == 0):
                    link, count = link.parent, count + 1
                    chains.setdefault(link.name, []).append(end)
    return chains


def _drivers_of(armature: bpy.types.Object, bone: str) -> list[Any]:
    data = armature.animation_data
    start = f'pose.bones["{bpy.utils.escape_identifier(bone)}"]'
    return [] if data is None else [d for d in data.drivers if d.data_path.startswith(start)]


def _driver_targets(armature: bpy.types.Object, bone: str) -> list[tuple[bpy.types.ID, str]]:
    return [pair for fcurve in _drivers_of(armature, bone) for pair in driver_targets(fcurve)]


def _bone_property(path: str) -> tuple[str, str]:
    """Bone and custom property of a path 'pose.bones["bone"]["property"]'; empty where it is none."""
    parts = path.split('"')
    return (parts[1], parts[3]) if len(parts) == 5 and parts[0] == "pose.bones[" and parts[2] == "][" else ("", "")


def _matrix(armature: bpy.types.Object, bone: str) -> mathutils.Matrix:
    bpy.context.view_layer.update()
    evaluated = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return evaluated.pose.bones[bone].matrix.copy()


def _best(
    armature: bpy.types.Object,
    bone: str,
    candidates: list[str],
    turn: Callable[[str], None],
    restore: Callable[[], None],
) -> tuple[float, str] | None:
    """How many bones the best candidate moves, and its name; None where none turns the bone as wanted."""
    before = _matrices(armature)
    own = armature.pose.bones[bone].matrix_basis.to_quaternion()
    turn(bone)
    asked = own.inverted() @ armature.pose.bones[bone].matrix_basis.to_quaternion()
    restore()
    wanted = before[bone].to_quaternion() @ asked
    best: tuple[float, str] | None = None
    for name in candidates:
        turn(name)
        after = _matrices(armature)
        restore()
        if _angle(wanted, after[bone].to_quaternion()) > MISS * max(asked.angle, 1e-6):
            continue
        moved = sum(_angle(before[b].to_quaternion(), after[b].to_quaternion()) > 1e-3 for b in before)
        if best is None or moved < best[0]:
            best = float(moved), name
    return best


def _matrices(armature: bpy.types.Object) -> dict[str, mathutils.Matrix]:
    """Evaluated matrices of the pose bones, in the armature's space."""
    bpy.context.view_layer.update()
    evaluated = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return {bone.name: bone.matrix.copy() for bone in evaluated.pose.bones}


def _angle(a: mathutils.Quaternion, b: mathutils.Quaternion) -> float:
    angle = float(a.rotation_difference(b).angle)
    return min(angle, 2 * math.pi - angle)


@contextmanager
def without_followers(armature: bpy.types.Object) -> Iterator[None]:
    """Meshes that follow the armature are not deformed inside the block: trying is about bones, and quick so."""
    modifiers: list[Any] = [
        modifier
        for obj in bpy.data.objects
        if any(getattr(modifier, "object", None) == armature for modifier in obj.modifiers)
        for modifier in obj.modifiers
        if modifier.show_viewport
    ]
    for modifier in modifiers:
        modifier.show_viewport = False
    try:
        yield
    finally:
        for modifier in modifiers:
            modifier.show_viewport = True
