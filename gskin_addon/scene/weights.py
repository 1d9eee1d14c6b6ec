# SPDX-License-Identifier: GPL-3.0-or-later
"""Skinning weights as vertex groups, and the binding of a splat object to an armature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.lbs import top_influences
from . import names
from .armature import deform_bone_names
from .attributes import write_attribute
from .bone_frames import armature_modifier, armature_of, bone_order, ensure_bone_frames
from .node_groups import find_display
from .rotation_nodes import add_rotation, frames_of
from .splat_object import is_splat_object, refuse_edit_mode
from .transforms import world_similarity

Array = NDArray[Any]


def write_weights(
    obj: bpy.types.Object,
    armature: bpy.types.Object,
    weights: Array,
    bones: Sequence[str] | None = None,
    *,
    max_influences: int = 4,
    confidence: Array | None = None,
) -> None:
    """Bind `obj` to `armature` with `weights` (N, B) as vertex groups named after the bones.

    bones: the B bone names of the weights' columns (default: the armature's deform bones). Every splat keeps its
    `max_influences` strongest bones, normalised. Vertex groups of the armature's bones are replaced, other groups
    stay. confidence: (N,) in 0..1, how sure the weights are; without it an earlier one is removed. One call inside
    an operator is one undo step.

    Raises InputError: shapes that do not match, NaN, bones that the armature lacks or that do not deform,
    non-uniform object scale, an object in Edit Mode.
    """
    deform = deform_bone_names(armature)
    bones = list(deform if bones is None else bones)
    _check(obj, armature, weights, bones, deform)
    columns = [bones.index(name) if name in bones else -1 for name in deform]
    dense = np.zeros((len(weights), len(deform)), dtype=np.float32)
    used = [place for place, column in enumerate(columns) if column >= 0]
    dense[:, used] = np.asarray(weights)[:, [columns[place] for place in used]]
    index, value = top_influences(dense, max_influences)
    value = value.astype(np.float32)

    frames = bind(obj, armature)
    _write_groups(obj, deform, index, value)
    _write_influences(obj, frames, deform, index, value)
    if confidence is not None:
        write_attribute(obj.data, names.CONFIDENCE, "FLOAT", confidence)
    elif names.CONFIDENCE in obj.data.attributes:
        obj.data.attributes.remove(obj.data.attributes[names.CONFIDENCE])


def read_weights(obj: bpy.types.Object, bones: Sequence[str] | None = None) -> tuple[Array, list[str]]:
    """Weights (N, B) float32 of the object's vertex groups as painted, not normalised, and the B bone names.

    bones: default the deform bones of the object's armature; a bone without a vertex group has weight 0.
    Raises InputError where the object follows no armature and no bones are given.
    """
    if bones is None:
        armature = armature_of(obj)
        if armature is None:
            raise InputError(f"'{obj.name}' follows no armature; bind it to one first.")
        bones = deform_bone_names(armature)
    refuse_edit_mode(obj)
    place = {name: index for index, name in enumerate(bones)}
    lookup = np.array([place.get(group.name, -1) for group in obj.vertex_groups] or [-1])
    vertices = obj.data.vertices
    counts = np.fromiter((len(v.groups) for v in vertices), dtype=np.int64, count=len(vertices))
    pairs = [(g.group, g.weight) for v in vertices for g in v.groups]
    dense = np.zeros((len(vertices), len(bones)), dtype=np.float32)
    if pairs:
        flat = np.array(pairs, dtype=np.float64)
        column = lookup[flat[:, 0].astype(np.int64)]
        row = np.repeat(np.arange(len(vertices)), counts)
        known = column >= 0
        dense[row[known], column[known]] = flat[known, 1]
    return dense, list(bones)


def bind(obj: bpy.types.Object, armature: bpy.types.Object) -> bpy.types.Object:
    """Let `obj` follow `armature`: parent (in place), Armature modifier, then the rotation nodes; gives the frames.

    Like Ctrl-P > Armature Deform, so that moving the armature object carries the splats along. Weights are untouched.
    """
    if not is_splat_object(obj):
        raise InputError(f"'{obj.name}' is no splat object; import a Gaussian splat .ply and select it.")
    refuse_edit_mode(obj)
    world_similarity(obj)
    frames = ensure_bone_frames(armature)
    if obj.parent != armature:
        world = obj.matrix_world.copy()
        obj.parent, obj.parent_type = armature, "OBJECT"
        obj.matrix_parent_inverse = armature.matrix_world.inverted()
        obj.matrix_world = world
    modifier = armature_modifier(obj)
    if modifier is None:
        modifier = obj.modifiers.new(names.ARMATURE_MODIFIER, "ARMATURE")
        # Behind whatever deforms the rest shape, before anything that draws.
        display = find_display(obj)
        if display is not None:
            obj.modifiers.move(obj.modifiers.find(modifier.name), obj.modifiers.find(display.name))
    modifier.object = armature
    modifier.use_vertex_groups, modifier.use_bone_envelopes = True, False
    # Dual quaternions would move the centres in another way than Eq. 1.
    modifier.use_deform_preserve_volume = False
    add_rotation(obj, frames, modifier)
    return frames


def update_rotation_weights(obj: bpy.types.Object) -> None:
    """Take over painted vertex groups into the attributes by which the rotation nodes turn the splats.

    Also follows changes of the armature: other bones, deform switched on or off, another armature in the modifier.
    Raises InputError where the object follows no armature.
    """
    armature = armature_of(obj)
    if armature is None:
        raise InputError(f"'{obj.name}' follows no armature; bind it to one first.")
    frames = bind(obj, armature)
    weights, bones = read_weights(obj, bone_order(frames))
    index, value = top_influences(weights, names.INFLUENCES)
    value = np.where(weights.max(axis=1, keepdims=True) > 0, value, 0)
    _write_influences(obj, frames, bones, index, value)


def repair_frames(obj: bpy.types.Object) -> bool:
    """After a copy of splats and armature: let the copy's rotation follow its own armature. True if it was needed."""
    armature, frames = armature_of(obj), frames_of(obj)
    if frames is None or armature is None or armature_of(frames) == armature:
        return False
    own = ensure_bone_frames(armature)
    if bone_order(own) != bone_order(frames):
        update_rotation_weights(obj)
    else:
        add_rotation(obj, own, armature_modifier(obj))
    return True


def _check(
    obj: bpy.types.Object, armature: bpy.types.Object, weights: Array, bones: Sequence[str], deform: Sequence[str]
) -> None:
    count = len(obj.data.vertices) if is_splat_object(obj) else 0
    if np.shape(weights) != (count, len(bones)):
        raise InputError(
            f"The weights have shape {np.shape(weights)} and '{obj.name}' has {count} splats for {len(bones)} bones; "
            "use weights that were made for these splats and this armature."
        )
    if not np.isfinite(weights).all() or np.min(weights, initial=0) < -1e-6:
        raise InputError(f"The weights for '{obj.name}' have NaN or negative values; make them again.")
    missing = [bone for bone in bones if bone not in set(deform)]
    if missing:
        raise InputError(
            f"Armature '{armature.name}' has no deform bone '{missing[0]}', for which there are weights; "
            "choose the armature that the weights were made with."
        )


def _write_groups(obj: bpy.types.Object, bones: Sequence[str], index: Array, value: Array) -> None:
    """Replace the vertex groups `bones` by the influences (N, k)."""
    for name in bones:
        group = obj.vertex_groups.get(name)
        if group is not None:
            obj.vertex_groups.remove(group)
    for bone, name in enumerate(bones):
        group = obj.vertex_groups.new(name=name)
        splat, slot = np.nonzero((index == bone) & (value > 0))
        add = group.add
        for vertex, weight in zip(splat.tolist(), value[splat, slot].tolist(), strict=True):
            add((vertex,), weight, "REPLACE")


def _write_influences(
    obj: bpy.types.Object, frames: bpy.types.Object, bones: Sequence[str], index: Array, value: Array
) -> None:
    """Store the strongest bones of every splat, by their place in the frames, for the rotation nodes."""
    order = {name: place for place, name in enumerate(bone_order(frames))}
    place = np.array([order.get(name, -1) for name in bones])
    slots = names.INFLUENCES
    bone = np.full((len(index), slots), -1, dtype=np.int32)
    weight = np.zeros((len(index), slots), dtype=np.float32)
    width = min(slots, index.shape[1])
    bone[:, :width], weight[:, :width] = place[index[:, :width]], value[:, :width]
    bone[weight <= 0] = -1
    # A splat without bones stays put: index -1 samples the identity, and it needs a weight to be seen.
    weight[:, 0] = np.where(weight.sum(axis=1) > 0, weight[:, 0], 1.0)
    for slot in range(slots):
        write_attribute(obj.data, names.BONE.format(slot), "INT", bone[:, slot])
        write_attribute(obj.data, names.WEIGHT.format(slot), "FLOAT", weight[:, slot])
    obj.data.update()
