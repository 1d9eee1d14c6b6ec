# SPDX-License-Identifier: GPL-3.0-or-later
"""The strongest bones of every splat: found in weights, stored as attributes for the nodes that turn the splats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.rig.lbs import few_influences, top_influences
from . import names
from .attributes import ObjectData, read_attribute, read_positions, write_attribute
from .bone_frames import armature_of, bone_order, has_bendy_bones
from .rotation_nodes import frames_of
from .steps import SLICE

Array = NDArray[Any]

CELLS = 500_000
"""Weights, of all bones, that one slice sorts."""


SAME = 1e-5
"""Weights that differ by no more are the same: what is stored in 32 bits is normalised again when it is read."""


def slice_rows(bones: int) -> int:
    """Splats of one slice that handles all their weights: fewer where there are many bones."""
    return max(1, min(SLICE, CELLS // max(1, bones)))


def strongest(rows: Array, k: int) -> tuple[Array, Array]:
    """Index and weight (N, k) of the strongest bones of weights (N, B); of two equal ones the first bone first.

    Weights that the pipeline has made sparse are not sorted again.
    """
    few = few_influences(rows, k)
    if few is not None:
        return few
    index, value = top_influences(rows, k)
    order = np.lexsort((index, -value), axis=1)
    return np.take_along_axis(index, order, axis=1), np.take_along_axis(value, order, axis=1)


def columns_of(index: Array, value: Array) -> Callable[[int], Array]:
    """Function of a bone that gives its weights (N,) from influences index (N, k), value (N, k)."""
    count, width = index.shape
    index, value = np.ravel(index), np.ravel(value)

    def column(bone: int) -> Array:
        places = np.flatnonzero(index == bone)
        places = places[value[places] > 0]  # an empty slot may name any bone
        weights = np.zeros(count, dtype=np.float32)
        weights[places // width] = value[places]
        return weights

    return column


def write_influences(
    obj: bpy.types.Object, order: Sequence[str], bones: Sequence[str], index: Array, value: Array
) -> None:
    """Store the strongest bones of every splat, by their place in the frames' bones `order`, for the nodes."""
    known = {name: place for place, name in enumerate(order)}
    place = np.array([known.get(name, -1) for name in bones], dtype=np.int32)
    slots = names.INFLUENCES
    bone = np.full((slots, len(index)), -1, dtype=np.int32)
    weight = np.zeros((slots, len(index)), dtype=np.float32)
    width = min(slots, index.shape[1])
    bone[:width], weight[:width] = place[index[:, :width].T], value[:, :width].T
    bone[weight <= 0] = -1
    # A splat without bones stays put: index -1 samples the identity, and it needs a weight to be seen.
    weight[0] = np.where(weight.sum(axis=0) > 0, weight[0], 1.0)
    for slot in range(slots):
        write_attribute(obj.data, names.BONE.format(slot), "INT", bone[slot])
        write_attribute(obj.data, names.WEIGHT.format(slot), "FLOAT", weight[slot])
    _keep_rest(obj)
    obj.data.update()


def turns_by(obj: bpy.types.Object, bones: Sequence[str], index: Array, value: Array) -> bool:
    """Whether the splats are turned by these strongest bones already, index and value (N, K) of `bones`."""
    frames = frames_of(obj)
    stored = read_influences(obj)
    if frames is None or stored is None:
        return False
    order = bone_order(frames)
    place = {name: number for number, name in enumerate(bones)}
    # One more column, for splats that no bone turns.
    there = np.array([*(place.get(name, -2) for name in order), -1], dtype=np.int64)
    bone, weight = stored
    if bone.max(initial=-1) >= len(order):
        return False
    bone = there[bone]
    still = bone[:, 0] == -1
    given, share = np.full((len(index), bone.shape[1]), -1, np.int64), np.zeros(weight.shape, np.float32)
    width = min(index.shape[1], bone.shape[1])
    given[:, :width], share[:, :width] = index[:, :width], value[:, :width]
    given[share <= 0] = -1
    weight = np.where(still[:, None], 0, weight)
    differ = (given != np.where(weight > 0, bone, -1)) | (np.abs(share - weight) > SAME)
    rows = np.flatnonzero(differ.any(axis=1))
    # Of nearly equal weights either may come first.
    for row in rows.tolist():
        one = {int(b): float(w) for b, w in zip(given[row], share[row], strict=True) if w > 0}
        other = {int(b): float(w) for b, w in zip(bone[row], weight[row], strict=True) if w > 0}
        if any(abs(one.get(b, 0.0) - other.get(b, 0.0)) > SAME for b in one.keys() | other.keys()):
            return False
    return True


def read_influences(obj: bpy.types.Object) -> tuple[Array, Array] | None:
    """Index (N, 4) int32 among the bone frames, -1 for none, and weight (N, 4) float32 that turn each splat; None where
    they are not all there."""
    slots = range(names.INFLUENCES)
    bone = [read_attribute(obj.data, names.BONE.format(slot)) for slot in slots]
    weight = [read_attribute(obj.data, names.WEIGHT.format(slot)) for slot in slots]
    if any(values is None for values in (*bone, *weight)):
        return None
    return np.stack(bone, axis=1), np.stack(weight, axis=1)


def rest_is_kept(obj: bpy.types.Object) -> bool:
    """Whether where the splats are at rest is stored as it is, if bendy bones move them, else not at all."""
    stored, armature = read_attribute(obj.data, names.REST), armature_of(obj)
    if armature is None or not has_bendy_bones(armature):
        return stored is None
    return stored is not None and np.array_equal(stored, read_positions(obj.data))


def _keep_rest(obj: bpy.types.Object) -> None:
    """Store where the splats are at rest, if bendy bones move them: which segment that is says the place at rest."""
    armature = armature_of(obj)
    mesh: ObjectData = obj.data
    if armature is not None and has_bendy_bones(armature):
        write_attribute(mesh, names.REST, "FLOAT_VECTOR", read_positions(mesh))
    elif names.REST in mesh.attributes:
        mesh.attributes.remove(mesh.attributes[names.REST])


def splats_without_bones(obj: bpy.types.Object) -> int:
    """Number of splats that no bone turns, as last written or taken over from the vertex groups."""
    strongest = read_attribute(obj.data, names.BONE.format(0))
    return len(obj.data.vertices) if strongest is None else int((strongest < 0).sum())


def strongest_bone(obj: bpy.types.Object) -> Array | None:
    """(N,) int32: the deform bone that moves each splat most, -1 for none; None where no armature moves them."""
    return read_attribute(obj.data, names.BONE.format(0))
