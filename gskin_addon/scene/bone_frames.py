# SPDX-License-Identifier: GPL-3.0-or-later
"""Bone frames: a helper mesh from which Geometry Nodes learns how the bones are turned.

Four vertices per deform bone (head, head + x, head + y, head + z, axes of the world), each fully weighted to its
bone, under the same Armature modifier as the splats. `rotation_nodes.py` reads the rotations off them; that works in
every Blender from 4.2 and with any constraint or driver, because it looks at what the modifier did.

The helper belongs to no collection: Blender evaluates it because the splats' modifier points to it, it is saved and
appended with them, and neither the outliner's scene view, nor renders, nor exporters see it. It has no parent either
(exporters follow children). One helper serves all splat objects of an armature.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from . import names
from .armature import deform_bone_names, read_skeleton
from .attributes import write_positions
from .helpers import hide_helper


def ensure_bone_frames(armature: bpy.types.Object) -> bpy.types.Object:
    """The armature's helper for its present deform bones; made where there is none.

    Raises InputError as `read_skeleton` does.
    """
    return find_bone_frames(armature) or _create(armature)


def find_bone_frames(armature: bpy.types.Object) -> bpy.types.Object | None:
    """A helper that already follows the armature with the same deform bones in the same order."""
    bones = deform_bone_names(armature)
    for obj in bpy.data.objects:
        if is_bone_frames(obj) and armature_of(obj) == armature and bone_order(obj) == bones and obj.library is None:
            return obj
    return None


def is_bone_frames(obj: bpy.types.Object | None) -> bool:
    """Whether `obj` is such a helper, which is no object of the artist's."""
    return obj is not None and obj.type == "MESH" and obj.get(names.FRAMES_MARK) is not None


def bone_order(frames: bpy.types.Object) -> list[str]:
    """Bone names by index. They are the helper's vertex groups, which Blender renames along with the bones."""
    return [group.name for group in frames.vertex_groups]


def armature_of(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The armature of the object's first Armature modifier."""
    modifier = armature_modifier(obj)
    return None if modifier is None else modifier.object


def armature_modifier(obj: bpy.types.Object) -> bpy.types.ArmatureModifier | None:
    """The object's first Armature modifier that has an armature, else its first one at all."""
    found: list[Any] = [modifier for modifier in obj.modifiers if modifier.type == "ARMATURE"]
    return next((modifier for modifier in found if modifier.object is not None), found[0] if found else None)


def _create(armature: bpy.types.Object) -> bpy.types.Object:
    skeleton = read_skeleton(armature)
    # Axes about as long as the skeleton: short ones would lose digits against the positions.
    size = float(np.ptp(np.concatenate([skeleton.heads, skeleton.tails]), axis=0).max())
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)]) * size
    mesh = bpy.data.meshes.new(f"GSkin Bone Frames ({armature.name})")
    mesh.vertices.add(4 * skeleton.count)
    write_positions(mesh, skeleton.heads[:, None] + corners)
    frames = bpy.data.objects.new(mesh.name, mesh)
    frames[names.FRAMES_MARK] = True
    hide_helper(frames)
    for index, bone in enumerate(skeleton.names):
        frames.vertex_groups.new(name=bone).add(range(4 * index, 4 * index + 4), 1.0, "REPLACE")
    modifier: Any = frames.modifiers.new(names.ARMATURE_MODIFIER, "ARMATURE")
    modifier.object = armature
    modifier.use_bone_envelopes = False
    return frames
