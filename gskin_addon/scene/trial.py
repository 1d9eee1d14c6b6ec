# SPDX-License-Identifier: GPL-3.0-or-later
"""A rig played through its range, and what stretches meanwhile; afterwards the pose is what it was, to the bit.

Each bone swings about the axes across it (about its own where it is limited there), between its limits: those of a
Limit Rotation constraint in its own space, else of its inverse kinematics, else 0.33 pi to both sides, the largest turn
of the paper's random poses (Sec. IV). Bones in different branches of the skeleton swing together. Or the poses of the
rig's pose library are gone to and left again, one after the other.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import bpy
import mathutils
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.skinning.edits.stretch import StretchMeter
from .armature import deform_bone_names, pose_transforms_of
from .bone_frames import armature_of, bone_order
from .controls import why_held
from .influences import read_influences
from .pose_assets import Values, poses_of, present_values, read_pose, set_values
from .posing import Channels, channels, restore
from .rotation_nodes import frames_of
from .selecting import iter_body_of
from .splat_object import read_cloud
from .steps import Steps, in_thread, run_to_end

Array = NDArray[Any]

WIDEST = 0.33 * np.pi
"""Radians to either side where a bone has no limits."""
LEAST = 0.004
"""Part of the splats that a bone and what hangs on it must move to be tried."""
SAMPLES = 12
"""Poses of one swing; the third and the ninth quarter are its ends."""


@dataclass(frozen=True)
class Swing:
    """Bones that turn at once, each about one of its own axes (0 to 2) from `low` to `high`, radians."""

    bones: tuple[tuple[str, int, float, float], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """What is to blame for what stretches meanwhile."""
        return tuple(name for name, *_ in self.bones)

    def samples(self) -> list[Sample]:
        """Its poses: from rest to one end, to the other, and back."""
        turns = np.sin(np.linspace(0, 2 * np.pi, SAMPLES + 1))[1:]
        ends = {SAMPLES // 4 - 1, 3 * SAMPLES // 4 - 1}
        return [Sample(self, float(turn), number in ends) for number, turn in enumerate(turns)]

    def show(self, armature: bpy.types.Object, reach: float) -> None:
        """Turn the bones, on top of their pose."""
        for name, axis, low, high in self.bones:
            turn_about(armature.pose.bones[name], axis, high * reach if reach > 0 else -low * reach)


@dataclass(frozen=True)
class LibraryPose:
    """A pose of the rig's pose library, and what its channels are before."""

    name: str
    values: Values
    before: Values

    @property
    def names(self) -> tuple[str, ...]:
        """See Swing."""
        return (self.name,)

    def samples(self) -> list[Sample]:
        """From the present pose to this one and back."""
        turns = np.sin(np.linspace(0, np.pi, SAMPLES // 2 + 1))[1:]
        return [Sample(self, float(turn), number == SAMPLES // 4 - 1) for number, turn in enumerate(turns)]

    def show(self, armature: bpy.types.Object, reach: float) -> None:
        """Blend the pose in."""
        blended = {key: was + reach * (self.values[key] - was) for key, was in self.before.items()}
        set_values(armature, self.values if reach == 1 else blended)


@dataclass(frozen=True)
class Sample:
    """One pose: how far (-1 low end, 0 rest, 1 high end) a swing has come; `is_end` where it is to be measured."""

    swing: Swing | LibraryPose
    reach: float
    is_end: bool


class Trial:
    """The splats of an object and their rig, on trial. `begin`, `show` samples one after the other, and `end` in any
    case.

    Raises InputError: no armature, or no bone that could be turned; of the `library`, no pose.
    """

    swings: Sequence[Swing | LibraryPose]

    def __init__(
        self, splats: bpy.types.Object, meter: StretchMeter | None = None, *, library: bool = False
    ) -> None:
        """meter: as from `iter_meter`, which is made here otherwise; library: the poses of the rig's pose library
        instead of the ranges of its bones."""
        self.meter, self.library = meter or run_to_end(iter_meter(splats)), library
        self.armature, self.swings = library_poses(splats) if library else rig_swings(splats)
        self.stretch = np.ones(len(self.meter.means), np.float32)
        self.worst = np.full(len(self.stretch), -1)
        self._channels: Channels = {}
        self._muted: list[tuple[str, str]] = []
        self._position = ""

    @property
    def samples(self) -> list[Sample]:
        """All poses, in order."""
        return [sample for swing in self.swings for sample in swing.samples()]

    def begin(self) -> None:
        """Remember the pose, and free the bones from what holds them."""
        self._position = self.armature.data.pose_position
        self._channels = channels(self.armature)
        self.armature.data.pose_position = "POSE"
        swinging = {name for swing in self.swings for name in swing.names}
        for bone in self.armature.pose.bones if not self.library else ():  # a library's poses turn the controls
            for constraint in bone.constraints:
                holds = bone.name in swinging and constraint.type != "LIMIT_ROTATION"
                if (holds or constraint.type in {"IK", "SPLINE_IK"}) and not constraint.mute:
                    constraint.mute = True
                    self._muted.append((bone.name, constraint.name))
        # What is muted builds the scene anew, and with it animation is evaluated once more.
        bpy.context.view_layer.update()

    def show(self, sample: Sample) -> None:
        """Pose the rig."""
        self._take_back()
        sample.swing.show(self.armature, sample.reach)
        bpy.context.view_layer.update()

    def measure(self, number: int, transforms: Array) -> None:
        """Take the stretch of one pose of swing `number` in. Knows nothing of Blender, so a thread may do it."""
        found = self.meter.measure(transforms)
        more = found > self.stretch
        self.stretch[more], self.worst[more] = found[more], number

    def end(self) -> None:
        """The pose of before; may be called more than once."""
        if not self._position:
            return
        for bone, constraint in self._muted:
            self.armature.pose.bones[bone].constraints[constraint].mute = False
        bpy.context.view_layer.update()
        self._take_back()
        self.armature.data.pose_position = self._position
        self._muted, self._position = [], ""
        bpy.context.view_layer.update()

    def _take_back(self) -> None:
        for swing in self.swings:
            if isinstance(swing, LibraryPose):
                set_values(self.armature, swing.before)
        restore(self.armature, self._channels)

    def run(self) -> Iterator[float]:
        """The whole trial at once, without anybody who watches: the share done after each end of a swing."""
        self.begin()
        try:
            ends = [sample for sample in self.samples if sample.is_end]
            for number, sample in enumerate(ends):
                self.show(sample)
                self.measure(self.swings.index(sample.swing), pose_transforms_of(self.armature))
                yield (number + 1) / len(ends)
        finally:
            self.end()

    def to_blame(self, marked: Array, most: int = 3) -> list[str]:
        """Bones, or poses, of the swings that stretch the most of the splats of a mask (N,) most, at most `most`."""
        numbers = self.worst[marked]
        count = np.bincount(numbers[numbers >= 0], minlength=len(self.swings))
        order = [number for number in np.argsort(-count, kind="stable").tolist() if count[number]]
        return list(dict.fromkeys(name for number in order for name in self.swings[number].names))[:most]


def iter_meter(splats: bpy.types.Object) -> Steps[StretchMeter]:
    """What measures the splats' stretch, in slices. Raises InputError: no armature that could be posed."""
    stored = _parts_of(splats)[2]
    graph, means = (yield from iter_body_of(splats)), read_cloud(splats).means
    return (yield from in_thread(lambda: StretchMeter(means, graph, *stored)))


def _parts_of(splats: bpy.types.Object) -> tuple[bpy.types.Object, bpy.types.Object, tuple[Array, Array]]:
    """Armature, bone frames and influences."""
    armature, frames, stored = armature_of(splats), frames_of(splats), read_influences(splats)
    if armature is None or frames is None or stored is None:
        raise InputError(f"'{splats.name}' follows no armature by weights of its own; bind it to one first.")
    if armature.library is not None:
        raise InputError(f"Armature '{armature.name}' is linked from another file; make a library override of it.")
    return armature, frames, stored


class Player:
    """Plays a trial in time, a little with each call of `step`; measures the ends of swings in a thread."""

    def __init__(self, trial: Trial, seconds: float) -> None:
        self.trial, self.seconds = trial, seconds
        self._samples, self._at = trial.samples, -1
        self._thread: threading.Thread | None = None

    def step(self, elapsed: float) -> bool:
        """Show the pose of `elapsed` seconds since the beginning; False when all has been shown and measured.

        A slow machine leaves poses out, but no end of a swing.
        """
        due = int(elapsed / self.seconds * len(self._samples))
        end = next((k for k in range(self._at + 1, len(self._samples)) if self._samples[k].is_end), len(self._samples))
        at = min(due, end)
        busy = self._thread is not None and self._thread.is_alive()
        if at <= self._at or (busy and at == end):
            return True
        self._at = at
        if at >= len(self._samples):
            if self._thread is not None:
                self._thread.join()
            return False
        sample = self._samples[at]
        self.trial.show(sample)
        if sample.is_end:
            work = self.trial.swings.index(sample.swing), pose_transforms_of(self.trial.armature)
            self._thread = threading.Thread(target=self.trial.measure, args=work, name="gskin", daemon=True)
            self._thread.start()
        return True


def rig_swings(splats: bpy.types.Object) -> tuple[bpy.types.Object, list[Swing]]:
    """The armature of the splats, and the swings of its bones. Raises InputError: no armature, or no bone that could
    be turned."""
    armature, frames, stored = _parts_of(splats)
    if bone_order(frames) != deform_bone_names(armature):
        raise InputError(f"The bones of '{armature.name}' have changed; click Bind Splats to Armature.")
    swings = swings_of(armature, bone_order(frames), *stored)
    if not swings:
        raise InputError(f"No bone of '{armature.name}' that moves splats of '{splats.name}' can be turned.")
    return armature, swings


def library_poses(splats: bpy.types.Object) -> tuple[bpy.types.Object, list[LibraryPose]]:
    """The armature of the splats, and the poses of its pose library in this file. Raises InputError: no armature, or
    no pose that changes it."""
    armature = _parts_of(splats)[0]
    found = []
    for part in poses_of(armature):
        values = read_pose(part)
        before = present_values(armature, values)
        if before:
            found.append(LibraryPose(part.action.name, {key: values[key] for key in before}, before))
    if not found:
        raise InputError(
            f"This file has no pose assets of '{armature.name}'; make some in Pose Mode (Pose > Create Pose Asset), or "
            "by Test Poses to Pose Library."
        )
    return armature, found


def swings_of(armature: bpy.types.Object, order: list[str], index: Array, value: Array) -> list[Swing]:
    """The swings of a rig whose bones `order` move splats with index (N, K) and weights value (N, K)."""
    share = np.bincount(index[(index >= 0) & (value > 0.3)], minlength=len(order)) / max(1, len(index))
    own = dict(zip(order, share.tolist(), strict=True))
    bones = armature.pose.bones
    moves = {b.name: own.get(b.name, 0.0) for b in bones}
    for bone in sorted(bones, key=lambda b: -len(b.parent_recursive)):
        if bone.parent is not None:
            moves[bone.parent.name] += moves[bone.name]
    roots = [b for b in bones if b.name in own and not any(p.name in own for p in b.parent_recursive)]
    held = {name: why_held(armature, name) for name in own}
    tried = []
    for name in deform_bone_names(armature):
        if moves[name] < LEAST or "is driven" in held[name]:
            continue
        if len(roots) == 1 and bones[name] == roots[0] and len(own) > 1:
            continue  # it would only turn the whole figure
        tried.append(name)
    depth: dict[str, int] = {}
    for name in tried:
        above = [depth[p.name] for p in bones[name].parent_recursive if p.name in depth]
        depth[name] = max(above, default=-1) + 1
    found = []
    for level in range(max(depth.values(), default=-1) + 1):
        ranges = {name: _ranges(bones[name], bool(held[name])) for name in tried if depth[name] == level}
        for axis in (0, 2, 1):
            swinging = tuple((name, axis, *r[axis]) for name, r in ranges.items() if axis in r)
            if swinging:
                found.append(Swing(swinging))
    return found


def _ranges(bone: bpy.types.PoseBone, held: bool) -> dict[int, tuple[float, float]]:
    """By axis: how far a bone may turn about it, radians; no entry for one about which it does not.

    held: constraints turn the bone. Locks of its channels then keep hands off it (Rigify locks all deform bones) and
    say nothing of how it moves.
    """
    found = {0: (-WIDEST, WIDEST), 2: (-WIDEST, WIDEST)}
    for axis, letter in enumerate("xyz"):
        if getattr(bone, f"use_ik_limit_{letter}"):
            found[axis] = getattr(bone, f"ik_min_{letter}"), getattr(bone, f"ik_max_{letter}")
        if getattr(bone, f"lock_ik_{letter}") or (bone.lock_rotation[axis] and not held):
            found.pop(axis, None)
    for constraint in bone.constraints:
        if constraint.type == "LIMIT_ROTATION" and constraint.owner_space == "LOCAL" and not constraint.mute:
            for axis, letter in enumerate("xyz"):
                if getattr(constraint, f"use_limit_{letter}"):
                    found[axis] = getattr(constraint, f"min_{letter}"), getattr(constraint, f"max_{letter}")
    full = {axis: (max(low, -np.pi), min(high, np.pi)) for axis, (low, high) in found.items()}
    return {axis: (min(low, 0.0), max(high, 0.0)) for axis, (low, high) in full.items() if high - low > 1e-3}


def turn_about(bone: bpy.types.PoseBone, axis: int, angle: float) -> None:
    """Turn a bone about one of its own axes, on top of its pose."""
    turn = mathutils.Quaternion(mathutils.Vector([float(k == axis) for k in range(3)]), angle)
    if bone.rotation_mode == "QUATERNION":
        bone.rotation_quaternion = bone.rotation_quaternion @ turn
    elif bone.rotation_mode == "AXIS_ANGLE":
        before, *about = bone.rotation_axis_angle
        way, after = (mathutils.Quaternion(about, before) @ turn).to_axis_angle()
        bone.rotation_axis_angle = (after, *way)
    else:
        mode: Any = bone.rotation_mode
        bone.rotation_euler = (bone.rotation_euler.to_quaternion() @ turn).to_euler(mode, bone.rotation_euler)
