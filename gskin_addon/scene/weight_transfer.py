# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights from a mesh or splats to other splats or another mesh, at rest, in world space, by the names of bones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.skinning.edits.keep import keep
from ..core.skinning.transfer.match import ANGLE, REACH
from ..core.skinning.transfer.transfer import Shape, Transferred, transfer
from . import names
from .anchored import proxy_of, read_world_mesh
from .armature import deform_bone_names
from .binding import follow
from .bone_frames import armature_of
from .fabric import iter_fabric, lay_under
from .object_ref import ObjectRef
from .proxy_object import followed_armature
from .seams import read_seams
from .splat_object import is_splat_object, read_cloud, refuse_edit_mode
from .steps import Steps, in_thread, part_of
from .vertex_groups import GroupsAside
from .weight_edits import iter_edit_weights, locked_groups
from .weights import iter_read_weights, iter_write_weights

Array = NDArray[Any]


@dataclass(frozen=True)
class Options:
    """As of `core.skinning.transfer.transfer.transfer`."""

    reach: float = REACH
    angle: float = ANGLE
    inpaint: bool = True
    fit: bool = False


@dataclass(frozen=True)
class Report:
    """changed: points whose weights are others now; taken: points that have the source's weights as they are; left_out:
    groups of the source that are no bones of the armature."""

    changed: int
    total: int
    taken: int
    left_out: tuple[str, ...]

    def words(self) -> str:
        """What was not simply taken over."""
        said = []
        filled = self.total - self.taken
        if filled:
            said.append(f"{filled:,} had no match and were filled in from around them")
        if self.left_out:
            listed = ", ".join(f"'{name}'" for name in self.left_out[:4]) + (", ..." if len(self.left_out) > 4 else "")
            said.append(f"groups that are no bones of the armature were left out: {listed}")
        return "; ".join(said)


def source_armature(source: bpy.types.Object) -> bpy.types.Object | None:
    """The armature that the weights of a mesh or splat object are for."""
    return followed_armature(source) if is_splat_object(source) else source.find_armature()


def iter_transfer_to_splats(
    source: bpy.types.Object,
    splats: bpy.types.Object,
    armature: bpy.types.Object,
    selected: Array | None = None,
    *,
    options: Options | None = None,
    lock: tuple[str, ...] = (),
    paintable: bool = False,
) -> Steps[Report]:
    """Give splats the weights of a mesh or of other splats for the bones of `armature`, by their names.

    Splats that follow an armature already keep locked groups, those in `lock`, and what is not in selected (N,) bool;
    others are bound to `armature`, with a fabric for Blender's weight tools where `paintable`. In slices; only the
    last changes the scene.

    Raises InputError: no weights for these bones, a source elsewhere, Edit Mode, objects that were changed meanwhile.
    """
    if proxy_of(splats) is not None:
        raise InputError(
            f"'{splats.name}' hangs on the mesh '{proxy_of(splats).name}', which moves it; give that its weights, or "
            "release the splats from it."
        )
    bones, ref = deform_bone_names(armature), ObjectRef(splats)
    weights, left_out = yield from part_of(_iter_read(source, bones, armature), 0.0, 0.2)
    target = _shape_of(splats)
    result = yield from part_of(_iter_work(_shape_of(source), weights, target, options or Options()), 0.2, 0.6)
    splats = ref.find()
    if armature_of(splats) == armature:
        edits = iter_edit_weights(splats, lambda _: result.weights, selected, lock=lock)
        count = yield from part_of(edits, 0.6, 1.0)
    else:
        fabric = None
        if paintable:
            bone = result.weights.argmax(axis=1)
            fabric = yield from part_of(iter_fabric(splats, bone, armature), 0.6, 0.7)
        yield from part_of(iter_write_weights(splats, armature, result.weights, bones), 0.7, 1.0)
        if fabric is not None:
            lay_under(splats, fabric)
        count = len(result.weights)
    return Report(count, len(result.weights), int(result.taken.sum()), left_out)


def iter_transfer_to_mesh(
    splats: bpy.types.Object,
    mesh: bpy.types.Object,
    selected: Array | None = None,
    *,
    options: Options | None = None,
) -> Steps[Report]:
    """Give the mesh object `mesh` the weights of splats that follow an armature, as vertex groups, and let it follow.

    Locked groups of the mesh and vertices that are not in selected (V,) bool keep theirs. The mesh gets a new
    datablock of the same name. In slices; only the last changes the scene.

    Raises InputError: splats that follow nothing, a mesh without faces or elsewhere, Edit Mode, changes meanwhile.
    """
    armature = followed_armature(splats)
    if armature is None:
        raise InputError(f"'{splats.name}' follows no armature; bind it to one first.")
    refuse_edit_mode(mesh)
    bones = deform_bone_names(armature)
    weights, left_out = yield from part_of(_iter_read(splats, bones, armature), 0.0, 0.2)
    target = _shape_of(mesh)
    before, _ = yield from part_of(iter_read_weights(mesh, bones), 0.2, 0.3)
    result = yield from part_of(_iter_work(_shape_of(splats), weights, target, options or Options()), 0.3, 0.6)
    locked = np.isin(bones, locked_groups(mesh, bones))
    after = keep(before, result.weights, selected=selected, locked=locked, most=names.INFLUENCES)
    written = [name for name, fixed in zip(bones, locked, strict=True) if not fixed]
    if not written:
        raise InputError(f"All vertex groups of '{mesh.name}' are locked; unlock those that may change.")
    with GroupsAside(mesh) as groups:
        column = [bones.index(name) for name in written]
        yield from part_of(groups.write(written, lambda i: np.ascontiguousarray(after[:, column[i]])), 0.6, 1.0)
        mesh = groups.check()
        if mesh.find_armature() is None:
            follow(mesh, armature, keep_parent=True)
        groups.commit()
    changed = int((after != before).any(axis=1).sum())
    return Report(changed, len(after), int(result.taken.sum()), left_out)


def _iter_read(
    source: bpy.types.Object, bones: list[str], armature: bpy.types.Object
) -> Steps[tuple[Array, tuple[str, ...]]]:
    """Weights (M, B) of the source for `bones`, and the names of its other groups."""
    if not source.vertex_groups:
        raise InputError(f"'{source.name}' has no vertex groups, so no weights to give; choose a skinned object.")
    known = set(bones)
    left_out = tuple(group.name for group in source.vertex_groups if group.name not in known)
    if len(left_out) == len(source.vertex_groups):
        raise InputError(
            f"No vertex group of '{source.name}' is called as a deform bone of '{armature.name}'; rename them as the "
            "bones."
        )
    weights, _ = yield from iter_read_weights(source, bones)
    return weights, left_out


def _shape_of(obj: bpy.types.Object) -> Callable[[], Shape]:
    """A function that makes the object's shape, at rest in world space; reads Blender now."""
    if is_splat_object(obj):
        cloud, walls = read_cloud(obj), read_seams(obj)
        return lambda: Shape.of_splats(cloud, walls)
    if any(modifier.type == "MIRROR" and modifier.show_viewport for modifier in obj.modifiers):
        raise InputError(f"'{obj.name}' has a Mirror modifier, so half of it is not there yet; apply the modifier.")
    verts, faces = read_world_mesh(obj)
    return lambda: Shape.of_mesh(verts, faces)


def _iter_work(
    source: Callable[[], Shape], weights: Array, target: Callable[[], Shape], options: Options
) -> Steps[Transferred]:
    """The transfer, in a thread."""

    def work() -> Transferred:
        return transfer(source(), weights, target(), **vars(options))

    return (yield from in_thread(work))
