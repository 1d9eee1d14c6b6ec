# SPDX-License-Identifier: GPL-3.0-or-later
"""One pose of rigged splats, as asked for from outside: it arrives at the splats, and stays, or is refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import bpy
import mathutils
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .actions import assign, belongs, choose_part, own_parts, parts_of
from .anchored import proxy_of
from .armature import deform_bone_names, pose_transforms_of
from .clip_losses import listed, posed_by_hand
from .controls import followers, set_property, switched, switches
from .dependencies import is_animated, needed_objects, unheard_drivers
from .frames import frame_of, go_to
from .posing import Channels, channels, hold_pose, pose_matrices, restore, turn_bones
from .weights import read_weights

Array = NDArray[Any]


@dataclass(frozen=True)
class Pose:
    """What is asked for: turns as `turn_bones` takes them, custom properties (bone, name, value), action, frame."""

    turns: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    settings: list[tuple[str, str, float]] = field(default_factory=list)
    action: str | None = None
    slot: str | None = None
    frame: float | None = None

    def __bool__(self) -> bool:
        return bool(self.turns or self.settings or self.action) or self.frame is not None


def pose_still(obj: bpy.types.Object, armature: bpy.types.Object, wanted: Pose) -> list[str]:
    """Pose the armature that the splats of `obj` follow; gives sentences about what had to be changed for it.

    Raises InputError: unknown bones, properties or actions, an action of another object, a turn that does not arrive
    at the splats, a pose that would not stay.
    """
    switched_on = _switch_on(obj)
    if not wanted:
        rests = armature.data.pose_position == "REST"
        return switched_on + [f"Armature '{armature.name}' is in Rest Position, and its splats with it"] * rests
    notes = switched_on
    if armature.data.pose_position == "REST":
        armature.data.pose_position = "POSE"
        notes.append(f"Armature '{armature.name}' was in Rest Position; it is in Pose Position now")
    needed = needed_objects(armature)
    notes += [f"The driver of {path} needs Python, which no file may run here; its value stays as it is"
              for path in unheard_drivers(needed)]  # fmt: skip
    if wanted.action is not None:
        notes += _use_action(armature, needed, wanted.action, wanted.slot)
    if wanted.frame is not None:
        if not is_animated(needed):
            notes.append(f"Nothing moves '{armature.name}': it is the same at every frame")
        go_to(bpy.context.scene, wanted.frame)
        by_hand = posed_by_hand(armature) if wanted.action is None and own_parts(armature) else []
        if by_hand:
            verb = "has no keys and stands" if len(by_hand) == 1 else "have no keys and stand"
            notes.append(
                f"{listed(by_hand)} of '{armature.name}' {verb} as posed by hand, as Blender shows it; with --action, "
                "and in the clips of a .glb, such bones are at rest"
            )
    if wanted.turns or wanted.settings:
        # Blender would take them back at the next change of frame, and on opening the file.
        notes += hold_pose(armature)
    for owner, prop, value in wanted.settings:
        _set(armature, owner, prop, value)
    notes += _turn(obj, armature, wanted.turns)
    _check_that_it_stays(armature)
    return notes


def _switch_on(obj: bpy.types.Object) -> list[str]:
    """Let the modifiers by which the splats follow their armature, or the mesh they hang on does, work; say which."""
    notes = []
    for carrier in filter(None, (obj, proxy_of(obj))):
        modifiers: Any = carrier.modifiers
        for modifier in modifiers:
            follows = modifier.type == "ARMATURE" and modifier.object is not None
            if follows and not (modifier.show_viewport and modifier.show_render):
                modifier.show_viewport = modifier.show_render = True
                notes.append(f"Modifier '{modifier.name}' of '{carrier.name}' was switched off; it is on now")
    return notes


def _use_action(
    armature: bpy.types.Object, needed: list[bpy.types.Object], name: str, slot: str | None
) -> list[str]:
    """Make an action that of the armature, and of those objects it needs for which the action has slots, too."""
    notes = []
    part = choose_part(armature, name, slot)
    data: Any = armature.animation_data
    playing = [] if data is None else [track for track in data.nla_tracks if not track.mute]
    for track in playing:
        track.mute, track.is_solo = True, False
    if playing:
        notes.append(f"NLA tracks of '{armature.name}' were muted for the action '{name}'")
    # A clip says how bones stand that it does not key: at rest, also in glTF. What was posed by hand is no part of it.
    for bone in armature.pose.bones:
        bone.matrix_basis = mathutils.Matrix()
    assign(armature, part)
    slotted = [found for found in parts_of(part.action) if found.slot is not None]
    for other in needed:
        own = [] if other == armature else [found for found in slotted if belongs(found, other)]
        if len(own) == 1:
            assign(other, own[0])
    _evaluate_frame()
    return notes


def _set(armature: bpy.types.Object, owner: str, prop: str, value: float) -> None:
    holder: Any = armature.pose.bones.get(owner)
    if holder is None:
        raise InputError(f"Armature '{armature.name}' has no bone '{owner}'; its bones are listed in Edit Mode.")
    if not isinstance(holder.get(prop), (bool, int, float)):
        numbers = [key for key, value in holder.items() if isinstance(value, (bool, int, float))]
        found = ", ".join(f"'{key}'" for key in numbers) or "none"
        raise InputError(f"Bone '{owner}' has no number '{prop}' among its custom properties; it has {found}.")
    set_property(armature, owner, prop, value)


def _turn(
    obj: bpy.types.Object, armature: bpy.types.Object, turns: Mapping[str, tuple[float, float, float]]
) -> list[str]:
    """Turn the bones after each other; refused where none of them moves a splat."""
    if not turns:
        return []
    notes, idle, moved = [], [], False
    carrying = _carrying_bones(obj, armature)
    for name, vector in turns.items():
        before, pose = _transforms(armature, carrying), channels(armature)
        notes += turn_bones(armature, {name: vector})
        if np.abs(_transforms(armature, carrying) - before).max(initial=0.0) >= _MOVED:
            moved = True
        elif any(vector):
            idle.append(_moves_nothing(obj, armature, name, carrying, pose))
    if idle and not moved:
        raise InputError(f"{idle[0]}.")
    return notes + idle


def _carrying_bones(obj: bpy.types.Object, armature: bpy.types.Object) -> list[str]:
    """Deform bones that have weights of splats, or of the mesh that the splats hang on."""
    carrier = proxy_of(obj) or obj
    weights, bones = read_weights(carrier, deform_bone_names(armature))
    return [bone for bone, used in zip(bones, (weights > 0).any(axis=0), strict=True) if used]


def _transforms(armature: bpy.types.Object, bones: list[str]) -> Array:
    order = deform_bone_names(armature)
    return pose_transforms_of(armature)[[order.index(bone) for bone in bones]]


def _moves_nothing(
    obj: bpy.types.Object, armature: bpy.types.Object, name: str, carrying: list[str], unturned: Channels
) -> str:
    """That a bone turns and no splat moves, and which switch lets it move them."""
    words = f"Bone '{name}' of '{armature.name}' moves no splats of '{obj.name}'"
    turned = channels(armature)
    for owner, prop in switches(armature, followers(armature, name)):
        with switched(armature, owner, prop) as value:
            after = _transforms(armature, carrying)
            restore(armature, unturned)
            before = _transforms(armature, carrying)
            restore(armature, turned)
        if np.abs(after - before).max(initial=0.0) >= _MOVED:
            return f"{words}; set '{prop}' of '{owner}' to {value:g} first (--set {owner} {prop} {value:g})"
    return f"{words}: neither it nor the bones that follow it have weights of splats"


def _evaluate_frame() -> None:
    go_to(bpy.context.scene, frame_of(bpy.context.scene))


def _check_that_it_stays(armature: bpy.types.Object) -> None:
    """Evaluate the frame anew, as opening the file does. Raises InputError where a bone is taken back."""
    before = pose_matrices(armature)
    _evaluate_frame()
    after = pose_matrices(armature)
    scale = max([bone.length for bone in armature.data.bones], default=1.0)
    for name, matrix in before.items():
        change = np.array(after[name]) - np.array(matrix)
        change[:3, 3] /= scale
        if np.abs(change).max() > _STAYS:
            raise InputError(
                f"Bone '{name}' of '{armature.name}' does not keep its pose: something that moves it takes it back "
                "whenever the frame is evaluated; mute what animates it."
            )


_MOVED = 1e-6
"""How much an entry of a bone's transform changes at least when it moves."""
_STAYS = 1e-3
"""How much an entry of a bone's matrix, lengths in those of the longest bone, may change in a pose that stays."""
