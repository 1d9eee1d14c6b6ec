# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones whose place beside their parent is a shear while a glTF export runs: its nodes have no word for that.

A bone that does not inherit all of its parent's scale or rotation, or that a constraint places, may be sheared in the
space of a parent that is stretched along one axis; its node then stands otherwise.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .bone_frames import armature_of
from .clip_losses import listed

Array = NDArray[Any]

SHEAR = 1e-3
"""Largest cosine between two axes of a bone in its parent's space that still counts as square."""


def sheared_bones(armature: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> list[str]:
    """Deform bones of the evaluated pose that glTF cannot place: they, or bones above them, are sheared by a parent."""
    bones: Any = armature.evaluated_get(depsgraph).pose.bones
    places = {bone.name: place for place, bone in enumerate(bones)}
    parents = np.array([-1 if bone.parent is None else places[bone.parent.name] for bone in bones], dtype=int)
    if not len(bones):
        return []
    matrices = np.array([bone.matrix for bone in bones], dtype=np.float64)[:, :3, :3]
    volumes = np.abs(np.linalg.det(matrices))
    own = matrices.copy()
    # In a parent without volume nothing has a place of its own.
    placed = (parents >= 0) & (volumes[parents] > 1e-12)
    own[placed] = np.linalg.solve(matrices[parents[placed]], matrices[placed])
    lengths = np.linalg.norm(own, axis=1, keepdims=True)
    axes = own / np.maximum(lengths, 1e-12)
    cosines = np.abs(np.einsum("nij,nik->njk", axes, axes) - np.eye(3) * (lengths > 1e-12).swapaxes(1, 2))
    wrong = (cosines.max(axis=(1, 2)) > SHEAR) & ((parents < 0) | placed)
    found = []
    for place, bone in enumerate(bones):  # parents come before their children
        wrong[place] |= parents[place] >= 0 and wrong[parents[place]]
        if wrong[place] and bone.bone.use_deform:
            found.append(bone.name)
    return found


@contextmanager
def shear_watched(armatures: Sequence[bpy.types.Object]) -> Iterator[dict[str, list[str]]]:
    """Gives a dictionary that fills with the sheared bones of each armature, now and at every frame that is sampled."""
    found: dict[str, list[str]] = {}

    def look(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
        depsgraph = depsgraph or bpy.context.evaluated_depsgraph_get()
        for armature in armatures:
            names = found.setdefault(armature.name, [])
            names += [name for name in sheared_bones(armature, depsgraph) if name not in names]

    bpy.app.handlers.frame_change_post.append(look)
    try:
        look(bpy.context.scene)
        yield found
    finally:
        bpy.app.handlers.frame_change_post.remove(look)


def sheared_carriers(
    objects: Sequence[bpy.types.Object],
    found: Mapping[str, Sequence[str]],
    stand_ins: Mapping[str, str],
    free: Mapping[str, Collection[str]],
) -> dict[str, list[str]]:
    """Of the bones that `shear_watched` found, by armature, those that splats among `objects` follow.

    stand_ins: of each bone that was added, the bone that it stands for. free: bones that splats do not follow
    themselves any more, by armature.
    """
    wrong: dict[str, list[str]] = {}
    for name, bones in found.items():
        followers = [obj for obj in objects if (rig := armature_of(obj)) is not None and rig.name == name]
        carrying = {group.name for obj in followers for group in obj.vertex_groups}
        alone = set(free.get(name, ()))
        names = [stand_ins.get(bone, bone) for bone in bones if bone in stand_ins or bone not in alone]
        names = [bone for bone in dict.fromkeys(names) if bone in carrying]
        if names:
            wrong[name] = names
    return wrong


def said_of_shear(found: Mapping[str, Sequence[str]]) -> list[str]:
    """Sentences about sheared bones, by armature."""
    return [
        f"glTF nodes cannot be sheared: {listed([*bones])} of '{name}' {'does' if len(bones) == 1 else 'do'} not stand "
        "in the file as in Blender, in some frame at least, because a parent is stretched along one axis and they do "
        "not go along with it; give that parent one scale for all axes, or let them inherit it (Inherit Scale, Full)."
        for name, bones in found.items()
        if bones
    ]
