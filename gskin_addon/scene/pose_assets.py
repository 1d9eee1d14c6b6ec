# SPDX-License-Identifier: GPL-3.0-or-later
"""Poses in Blender's pose library: each an action with one key a channel that is marked as an asset."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from . import names
from .actions import Part, curves_of, is_own, parts_of, users_of

Values = Mapping[tuple[str, int], float]
"""Numbers by data path, as seen from the armature object, and place in its array (0 where there is none)."""


@dataclass(frozen=True)
class Pose:
    """What one pose of a library is: values, and the words that the library shows and finds it by."""

    name: str
    values: Values
    tags: Sequence[str] = ()
    description: str = ""


def write_pose(armature: bpy.types.Object, pose: Pose, catalog: str = "") -> bpy.types.Action:
    """A new pose asset of the armature, known by `clear_poses`; catalog: its id, empty for none."""
    action = bpy.data.actions.new(pose.name)
    curves = _new_curves(action, armature)
    for (path, index), value in pose.values.items():
        curve = curves.new(path, index=index)
        curve.keyframe_points.insert(1.0, value)
        curve.update()
    action.user_clear()  # a new action has a user, and an asset gets one more
    action.asset_mark()
    data: Any = action.asset_data
    data.description = pose.description
    for tag in pose.tags:
        data.tags.new(tag, skip_if_exists=True)
    if catalog:
        data.catalog_id = catalog
    action[names.TEST_POSE] = _mark_of(armature)
    return action


def clear_poses(armature: bpy.types.Object) -> int:
    """Remove the poses that `write_pose` made for the armature, and give their number. One that is used by now, as an
    armature's action or in the NLA, is the artist's: it stays, and is no asset any more."""
    mark = armature.get(names.TEST_POSE)
    found = [a for a in bpy.data.actions if mark and a.get(names.TEST_POSE) == mark and a.library is None]
    for action in found:
        if any(users_of(part) for part in parts_of(action)):
            action.asset_clear()
            del action[names.TEST_POSE]
        else:
            bpy.data.actions.remove(action)
    return len(found)


def poses_of(armature: bpy.types.Object) -> list[Part]:
    """The pose assets of this file that are the armature's own, by name: assets with no more than one frame."""
    found = []
    for action in bpy.data.actions:
        frames: Any = action.frame_range
        if action.asset_data is None or frames[1] > frames[0]:
            continue
        own = action.get(names.TEST_POSE) is not None and action.get(names.TEST_POSE) == armature.get(names.TEST_POSE)
        found += [part for part in parts_of(action) if curves_of(part) and (own or is_own(part, armature))]
    return sorted(found, key=lambda part: part.action.name)


def read_pose(part: Part) -> Values:
    """The values of a pose asset."""
    return {(c.data_path, c.array_index): float(c.evaluate(part.action.frame_range[0])) for c in curves_of(part)}


def present_values(armature: bpy.types.Object, keys: Iterable[tuple[str, int]]) -> Values:
    """What these channels are now; those that the armature lacks are left out."""
    found = {}
    for path, index in keys:
        try:
            value: Any = armature.path_resolve(path)
        except ValueError:  # a bone or a property that is gone; Blender passes it over, too
            continue
        if isinstance(value, (int, float)):
            found[path, index] = float(value)
        elif not isinstance(value, str) and index < len(value):
            found[path, index] = float(value[index])
    return found


def set_values(armature: bpy.types.Object, values: Values) -> None:
    """Set channels that are there (`present_values`)."""
    for (path, index), number in values.items():
        value: Any = armature.path_resolve(path)
        if not isinstance(value, (int, float)):
            value[index] = number
        elif path.endswith('"]'):
            owner, _, prop = path.rpartition('["')
            armature.path_resolve(owner)[bpy.utils.unescape_identifier(prop[:-2])] = type(value)(number)
        else:
            owner, _, prop = path.rpartition(".")
            setattr(armature.path_resolve(owner) if owner else armature, prop, type(value)(number))
    armature.update_tag()


def set_preview(action: bpy.types.Action, pixels: NDArray[Any]) -> None:
    """Show a picture (H, W, 4), sRGB from 0 to 1 with the first row on top, for the asset."""
    height, width = pixels.shape[:2]
    preview: Any = action.preview_ensure()
    preview.image_size = width, height
    preview.image_pixels_float.foreach_set(np.ascontiguousarray(pixels[::-1], np.float32).ravel())


def _new_curves(action: bpy.types.Action, armature: bpy.types.Object) -> Any:
    """Where F-curves of the armature go in a new action: from Blender 4.4 on in a slot of its own."""
    slots: Any = getattr(action, "slots", None)
    if slots is None:
        old: Any = action
        return old.fcurves
    slot = slots.new("OBJECT", armature.name)
    layers: Any = action.layers
    return layers.new("Layer").strips.new(type="KEYFRAME").channelbag(slot, ensure=True).fcurves


def _mark_of(armature: bpy.types.Object) -> str:
    """What tells the poses made for the armature from all others; it outlives another name of the armature."""
    if armature.get(names.TEST_POSE) is None:
        armature[names.TEST_POSE] = secrets.token_hex(8)
    return str(armature[names.TEST_POSE])
