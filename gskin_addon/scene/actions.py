# SPDX-License-Identifier: GPL-3.0-or-later
"""Whose an action is. From Blender 4.4 an action has slots, one for each thing that it moves; before, it is one whole.

An action's part is an object's if the object uses it, now or in the NLA. One that nobody uses is the object's by the
name of its slot, or, where that names nobody, because it moves the object's bones. So it is with all loose actions of
files from before 4.4. Where another armature has these bones, too, nothing says whose it is: such a part is asked for
or left out with a word, and never taken in silence.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import bpy

from ..core.errors import InputError

_BONE = re.compile(r'^pose\.bones\["((?:[^"\\]|\\.)*)"\]')

_PLACE = re.compile(r"^(delta_)?(location|scale|rotation_(euler|quaternion|axis_angle))$")


@dataclass(frozen=True)
class Part:
    """An action and one of its slots; slot None in Blender before 4.4, where there are none."""

    action: bpy.types.Action
    slot: Any = None

    @property
    def name(self) -> str:
        return self.action.name if self.slot is None else f"{self.action.name}', slot '{self.slot.name_display}"


def parts_of(action: bpy.types.Action) -> list[Part]:
    """The parts of an action that may move objects."""
    slots: Any = getattr(action, "slots", None)
    if slots is None:
        return [Part(action)] if getattr(action, "id_root", "OBJECT") == "OBJECT" else []
    return [Part(action, slot) for slot in slots if slot.target_id_type in {"OBJECT", "UNSPECIFIED"}]


def curves_of(part: Part) -> list[bpy.types.FCurve]:
    """The F-curves of a part."""
    if part.slot is None:
        old: Any = part.action
        return list(old.fcurves)
    found = []
    layers: Any = part.action.layers
    for layer in layers:
        for strip in layer.strips:
            bag = strip.channelbag(part.slot)
            found += [] if bag is None else list(bag.fcurves)
    return found


def bones_of(part: Part) -> set[str]:
    """Names of the bones that a part moves."""
    found = (_BONE.match(curve.data_path) for curve in curves_of(part))
    return {match.group(1).replace('\\"', '"').replace("\\\\", "\\") for match in found if match}


def keys_place(obj: bpy.types.Object) -> bool:
    """Whether an action, the NLA or drivers put the object where it is, whatever else moves its bones."""
    data = obj.animation_data
    if data is None:
        return False
    actions = {data.action, *(strip.action for track in data.nla_tracks for strip in track.strips)} - {None}
    parts = [part for action in actions for part in parts_of(action) if obj in users_of(part)]
    curves = [*(curve for part in parts for curve in curves_of(part)), *data.drivers]
    return any(_PLACE.match(curve.data_path) for curve in curves)


def users_of(part: Part) -> set[bpy.types.ID]:
    """What uses a part, now or in the NLA."""
    if part.slot is not None:
        return set(part.slot.users())
    users: Any = bpy.data.user_map(subset=[part.action])
    return set(users.get(part.action, ()))


def belongs(part: Part, obj: bpy.types.Object) -> bool:
    """Whether a part of an action is the object's own."""
    return not foreign_reason(part, obj)


def foreign_reason(part: Part, obj: bpy.types.Object) -> str:
    """Why a part is not the object's own, to follow "the action ..."; empty where it is."""
    users = users_of(part)
    if obj in users:
        return ""
    if users:
        return "belongs to " + ", ".join(sorted(f"'{user.name}'" for user in users))
    named = _named(part)
    if named == obj.name:
        return ""
    other: bpy.types.Object | None = bpy.data.objects.get(named)
    if other is not None and other != obj:
        return f"belongs to '{named}'"
    moved = bones_of(part)
    if not moved:
        return f"moves no bone of '{obj.name}'"
    known = _bones(obj)
    if 2 * len(moved & known) < len(moved):
        return f"moves bones that '{obj.name}' does not have, such as '{min(moved - known)}'"
    better = [other for other in _armatures(obj) if len(moved & _bones(other)) > len(moved & known)]
    if better:
        missing = min((moved & _bones(better[0])) - known)
        return f"fits '{better[0].name}' better, which has bone '{missing}', too"
    return ""


def own_parts(obj: bpy.types.Object) -> list[Part]:
    """The parts of all actions of the file that are surely the object's own."""
    return [part for part in _fitting(obj) if not rivals(part, obj)]


def is_own(part: Part, obj: bpy.types.Object) -> bool:
    """Whether a part of an action is surely the object's own."""
    return belongs(part, obj) and not rivals(part, obj)


def left_to_guess(obj: bpy.types.Object) -> list[str]:
    """Sentences about actions that may be the object's as well as another's, and that nobody uses."""
    found: dict[tuple[str, ...], list[str]] = {}
    for part in _fitting(obj):
        others = tuple(rivals(part, obj))
        if others:
            found.setdefault(others, []).append(f"'{part.action.name}'")
    return [
        f"{len(names)} unused {'action' if len(names) == 1 else 'actions'} ({', '.join(names[:5])}"
        f"{', ...' if len(names) > 5 else ''}) may belong to '{obj.name}' or to {' or to '.join(others)}, and nothing "
        f"says to which, so they are left out; assign them to their armature (in its NLA), save, and try again."
        for others, names in found.items()
    ]


def _fitting(obj: bpy.types.Object) -> list[Part]:
    return [part for action in bpy.data.actions for part in parts_of(action) if belongs(part, obj)]


def choose_part(obj: bpy.types.Object, name: str, slot: str | None = None) -> Part:
    """The part of the action `name` that is the object's; `slot` chooses where several could be.

    Raises InputError: no such action or slot, another's, several that fit.
    """
    action: bpy.types.Action | None = bpy.data.actions.get(name)
    if action is None:
        others = ", ".join(f"'{found.name}'" for found in bpy.data.actions) or "none"
        raise InputError(f"There is no action '{name}'; the file has {others}.")
    parts = parts_of(action)
    if slot is not None:
        names = ", ".join(f"'{part.slot.name_display}'" for part in parts if part.slot is not None) or "none"
        parts = [part for part in parts if part.slot is not None and part.slot.name_display == slot]
        if not parts:
            raise InputError(f"The action '{name}' has no slot '{slot}' for objects; it has {names}.")
    fitting = [part for part in parts if belongs(part, obj)]
    if not fitting:
        reasons = list(dict.fromkeys(foreign_reason(part, obj) for part in parts)) or ["moves no objects"]
        own = ", ".join(sorted({f"'{part.action.name}'" for part in own_parts(obj)})) or "none"
        raise InputError(f"The action '{name}' {' and '.join(reasons)}; actions of '{obj.name}': {own}.")
    preferred = [part for part in fitting if _preferred(part, obj)] or fitting
    if len(preferred) > 1:
        slots = ", ".join(f"'{part.slot.name_display}'" for part in preferred)
        raise InputError(f"The action '{name}' has several slots that fit '{obj.name}': {slots}; choose with --slot.")
    owners = [] if slot is not None else rivals(preferred[0], obj)
    if owners:
        raise InputError(
            f"The action '{name}' fits '{obj.name}' and {' and '.join(owners)}, and Blender before 4.4 does not keep "
            "whose it is; assign it to its armature, save the file, and try again."
        )
    return preferred[0]


def assign(obj: bpy.types.Object, part: Part) -> None:
    """Make a part the object's active action."""
    data: Any = obj.animation_data or obj.animation_data_create()
    data.use_tweak_mode = False  # in it the active action cannot be changed
    if data.action is not None and data.action != part.action:
        data.action.use_fake_user = True
    data.action = part.action
    if part.slot is not None:
        data.action_slot = part.slot


def drop_foreign(actions: Iterable[bpy.types.Action], kept: Iterable[bpy.types.Object]) -> list[str]:
    """Remove what of these actions is none of the kept objects', nor of their data's; gives sentences about doubts.

    To be called while the others are still there: what they use is known as theirs. What may be a kept object's as
    well as another's is removed, too, and said.
    """
    objects = list(kept)
    ids = {*objects, *(obj.data for obj in objects if obj.data is not None)}
    ids |= {keys for data in [*ids] if (keys := getattr(data, "shape_keys", None)) is not None}
    doubts = [sentence for obj in objects for sentence in left_to_guess(obj)]
    wanted = {
        (action, part.slot and part.slot.identifier)
        for action in actions
        for part in parts_of(action)
        if any(is_own(part, obj) for obj in objects)
    }
    for action in list(actions):
        slots: Any = getattr(action, "slots", None)
        if slots is None:
            if not (users_of(Part(action)) & ids or (action, None) in wanted):
                bpy.data.actions.remove(action)
            continue
        for slot in list(slots):
            if not (users_of(Part(action, slot)) & ids or (action, slot.identifier) in wanted):
                slots.remove(slot)
        if not len(slots):
            bpy.data.actions.remove(action)
    return doubts


def rivals(part: Part, obj: bpy.types.Object) -> list[str]:
    """Other armatures, in quotes, whose a part that fits `obj` may be as well: nobody uses it, no name says whose."""
    if users_of(part) or _named(part) == obj.name:
        return []
    moved, last = bones_of(part), _used_last(part, obj)
    # An armature that has a slot of its own in the action is not meant by another one.
    slotted = [other for other in parts_of(part.action) if other.slot is not None]
    settled = {user for other in slotted for user in users_of(other)} | {_named(other) for other in slotted}
    found = []
    for other in _armatures(obj):
        known = len(moved & _bones(other)) >= len(moved & _bones(obj))
        if known and settled.isdisjoint((other, other.name)) and _used_last(part, other) >= last:
            found.append(f"'{other.name}'")
    return sorted(found)


def _armatures(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """The other armatures of the file, without the linked ones that `obj` was made of."""
    made_of = obj.override_library.reference if obj.override_library is not None else None
    return [
        other
        for other in bpy.data.objects
        if other.type == "ARMATURE" and other not in (obj, made_of) and not (other.library and other.name == obj.name)
    ]


def _bones(obj: bpy.types.Object) -> set[str]:
    return {bone.name for bone in obj.data.bones} if obj.type == "ARMATURE" else set()


def _named(part: Part) -> str:
    """The name of the object that a part was made for; empty where nothing says so."""
    if part.slot is not None:
        return str(part.slot.identifier)[2:]
    # Blender's FBX importer: "Rig|Walk"
    return part.action.name.partition("|")[0] if "|" in part.action.name else ""


def _preferred(part: Part, obj: bpy.types.Object) -> bool:
    return obj in users_of(part) or _named(part) == obj.name or _used_last(part, obj)


def _used_last(part: Part, obj: bpy.types.Object) -> bool:
    """Whether the object's last action had a slot of this name; files from before 4.4 give all actions the same."""
    data: Any = obj.animation_data
    return part.slot is not None and data is not None and data.last_slot_identifier == part.slot.identifier
