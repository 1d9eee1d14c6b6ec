# SPDX-License-Identifier: GPL-3.0-or-later
"""Which control to use for a bone that cannot be turned by itself, as Rigify's DEF- bones cannot.

What a bone follows is found by walking constraints, drivers and parents; which of those bones turns it as wanted is
found by trying.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import bpy
import mathutils

from .dependencies import driver_targets, pointed_objects

NEAR, FAR = 0.02, 0.5
"""Radians (and parts of the bone's length) by which a control may miss: to be named as it, or at all."""
_TRIED = 24

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
    """The control that turns `bone` as turn(bone) would if the bone were free; None where none does.

    turn turns a bone by its name, as wanted; restore takes all turns back. The rig's pose must be at rest from turns.
    """
    wanted = _wanted(armature, bone, turn, restore)
    candidates = [name for name in sources(armature, bone) if name != bone]
    candidates.sort(key=lambda name: name.startswith(INNER))
    plain = _best(armature, bone, wanted, candidates, turn, restore)
    if plain is not None and plain[0] <= NEAR:
        return Control(plain[1])
    for owner, prop in switches(armature, [bone, *candidates]):
        holder: Any = armature.pose.bones[owner]
        before = holder[prop]
        other = type(before)(0 if before >= 0.5 else 1)
        try:
            _set(armature, owner, prop, other)
            found = _best(armature, bone, wanted, candidates, turn, restore)
        finally:
            _set(armature, owner, prop, before)
        if found is not None and found[0] <= NEAR:
            return Control(found[1], owner, prop, float(other))
    return Control(plain[1]) if plain is not None and plain[0] <= FAR else None


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


def switches(armature: bpy.types.Object, bones: list[str]) -> list[tuple[str, str]]:
    """Custom properties (bone, name) between 0 and 1 that drive how much the bones' constraints count."""
    found = []
    for bone in bones:
        for fcurve in _drivers_of(armature, bone):
            if ".constraints[" not in fcurve.data_path:
                continue
            for ident, path in driver_targets(fcurve):
                owner, prop = _bone_property(path)
                if ident == armature and owner in armature.pose.bones and (owner, prop) not in found:
                    value: Any = armature.pose.bones[owner].get(prop)
                    if isinstance(value, (int, float)) and 0 <= value <= 1:
                        found.append((owner, prop))
    return found[:6]


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


def _wanted(
    armature: bpy.types.Object, bone: str, turn: Callable[[str], None], restore: Callable[[], None]
) -> mathutils.Matrix:
    """Where the bone would be if it were free: its present matrix, turned in its own axes as its channels are."""
    present, holder = _matrix(armature, bone), armature.pose.bones[bone]
    before = holder.matrix_basis.to_quaternion()
    turn(bone)
    own = before.inverted() @ holder.matrix_basis.to_quaternion()
    restore()
    return present @ own.to_matrix().to_4x4()


def _best(
    armature: bpy.types.Object,
    bone: str,
    wanted: mathutils.Matrix,
    candidates: list[str],
    turn: Callable[[str], None],
    restore: Callable[[], None],
) -> tuple[float, str] | None:
    """How far the best candidate misses, and its name; None where none moves the bone."""
    length = max(armature.data.bones[bone].length, 1e-9)
    before = _matrix(armature, bone)
    best: tuple[float, str] | None = None
    for name in candidates[:_TRIED]:
        turn(name)
        after = _matrix(armature, bone)
        restore()
        if _miss(before, after, length) < 1e-3:
            continue
        miss = _miss(wanted, after, length)
        if best is None or miss < best[0] - 1e-4:
            best = miss, name
        if miss <= NEAR:
            break
    return best


def _miss(a: mathutils.Matrix, b: mathutils.Matrix, length: float) -> float:
    turn = a.to_quaternion().rotation_difference(b.to_quaternion()).angle
    return float(min(turn, 2 * 3.141592653589793 - turn) + (a.translation - b.translation).length / length)
