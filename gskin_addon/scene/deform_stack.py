# SPDX-License-Identifier: GPL-3.0-or-later
"""What moves the splats of an object: its modifiers, and what they do around each splat, by finite differences.

Linear blend skinning by vertex groups, bendy bones among them, has formulas (`core.rig.lbs`). Whatever else a stack of
modifiers can do (envelopes, Preserve Volume, masks, a second armature, lattices) is asked of Blender itself: a copy of
the splats is displaced and evaluated again.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.covariance import transform_gaussians
from ..core.rig.stretch import polar
from . import names
from .attributes import ObjectData, read_attribute, read_positions, write_positions
from .modifier_stack import beyond_groups, blind, deforming_modifiers, is_blind
from .probes import has_fitting_probes
from .transforms import world_similarity

Array = NDArray[Any]

STEP = 1e-3
"""Displacement of finite differences, as a part of the splats' extent: 32-bit coordinates leave 1e-4 of the map."""

NO_BENDS = "glTF has no bendy bones"
"""How the sentence about them begins."""

_COPY_OF = "gskin_copy_of"


def beyond_linear_blending(obj: bpy.types.Object) -> list[str]:
    """Why the splats are not moved by plain linear blend skinning with their vertex groups: reasons, none if they are.

    Bendy, scaled and mirrored bones are no reason.
    """
    volume = [f"'{m.name}' preserves volume" for m in deforming_modifiers(obj) if _preserves_volume(m)]
    keys = ["shape keys move them"] if _has_moving_keys(obj) else []
    return keys + volume + beyond_groups(obj)


def _has_moving_keys(obj: bpy.types.Object) -> bool:
    """Whether shape keys move the points now."""
    keys: Any = getattr(obj.data, "shape_keys", None)
    if keys is None or len(keys.key_blocks) < 2:
        return False
    if obj.show_only_shape_key or not keys.use_relative:
        return True
    return any(key.value and not key.mute for key in keys.key_blocks if key != keys.reference_key)


def not_in_the_viewport(obj: bpy.types.Object) -> list[str]:
    """Of these reasons, those that the rotation nodes do not follow: there splats go along, but turn without.

    None where the splats have probes (`probes.py`) for the modifiers that they have now.
    """
    if has_fitting_probes(obj):
        return []
    return beyond_groups(obj, [modifier for modifier in deforming_modifiers(obj) if not is_blind(modifier)])


def shown_wrongly(obj: bpy.types.Object) -> list[str]:
    """Sentences about what Blender's 3D view and its own engines do not show of how the splats turn."""
    found = []
    try:
        world_similarity(obj)
    except InputError as error:
        found.append(f"Blender moves the splats, and turns and sizes them wrongly: {error.plain}")
    reasons = not_in_the_viewport(obj)
    if reasons:
        found.append(
            f"Blender turns the splats of '{obj.name}' by vertex groups alone, in the 3D view and in Cycles, but "
            f"{'; '.join(reasons)}. Right are Render Splats, gskin render and the splats that gskin pose writes."
        )
    found += [
        f"Modifier '{name}' moves the splats of '{obj.name}' and turns none of them: it does not ask where they are."
        for name in blind(obj)
    ]
    return found


def bendy_bones(obj: bpy.types.Object) -> list[str]:
    """Names of the bones with segments that move the splats by a vertex group."""
    groups = {group.name for group in obj.vertex_groups}
    armatures = [modifier.object for modifier in deforming_modifiers(obj) if modifier.type == "ARMATURE"]
    bones = [bone for armature in armatures if armature is not None for bone in armature.data.bones]
    return [bone.name for bone in bones if bone.use_deform and bone.bbone_segments > 1 and bone.name in groups]


def lost_in_gltf(obj: bpy.types.Object, *, segments: bool = False) -> list[str]:
    """Sentences about what moves the splats here, and has no word in glTF.

    segments: those of bendy bones are joints in the file (`gltf_bends.py`).
    """
    found = []
    bendy = [] if segments else bendy_bones(obj)
    if bendy:
        named = ", ".join(f"'{name}'" for name in bendy[:3]) + (", ..." if len(bendy) > 3 else "")
        found.append(
            f"{NO_BENDS}: {len(bendy)} that move '{obj.name}' ({named}) are without segments in it, and "
            "what bends along them is straight."
        )
    reasons = beyond_linear_blending(obj)
    if reasons:
        found.append(
            f"glTF blends bones linearly by vertex groups; of '{obj.name}' it does not show that {'; '.join(reasons)}."
        )
    return found


def _preserves_volume(modifier: Any) -> bool:
    return bool(modifier.type == "ARMATURE" and modifier.object and modifier.use_deform_preserve_volume)


def measured_deform(obj: bpy.types.Object) -> tuple[Array, Array]:
    """Where the modifiers put the splats, (N, 3), and the linear map around each, (N, 3, 3), in the object's space.

    By central differences: seven evaluations. Modifiers that do not ask where a point is move splats and have no part
    in the maps. Raises InputError where a modifier changes the number of points.
    """
    with _deformed_copy(obj) as copy:
        points = read_positions(copy.data).astype(np.float64)
        step = STEP * float(np.ptp(points, axis=0).max()) or STEP
        maps = np.empty((len(points), 3, 3))
        moved = _evaluated(copy, points)
        for modifier in [modifier for modifier in copy.modifiers if is_blind(modifier)]:
            copy.modifiers.remove(modifier)
        for axis, offset in enumerate(np.eye(3) * step):
            # The differences of what 32 bits make of the displaced points.
            ends = [(points + sign * offset).astype(np.float32) for sign in (1, -1)]
            width = (ends[0].astype(np.float64) - ends[1])[:, axis]
            maps[:, :, axis] = (_evaluated(copy, ends[0]) - _evaluated(copy, ends[1])) / width[:, None]
    return moved, maps


def measured_splats(obj: bpy.types.Object) -> tuple[Array, Array, Array, Array]:
    """Points (N, 3), rotations (N, 4), scales (N, 3) and turns (N, 4) of the splats, as `measured_deform` has them.

    float32, in the object's space.
    """
    moved, maps = measured_deform(obj)
    rotation, scale = (read_attribute(obj.data, name) for name in (names.ROTATION, names.SCALE))
    quats, sizes = transform_gaussians(rotation, scale, maps)
    turn = polar(maps)[0]
    found = [np.asarray(values, np.float32) for values in (moved, quats, sizes, turn)]
    return found[0], found[1], found[2], found[3]


@contextmanager
def _deformed_copy(obj: bpy.types.Object) -> Iterator[Any]:
    """A copy of the object in the scene, with a mesh of its own and with the modifiers that deform it.

    Shape keys, which would overrule what is written to the mesh, are applied.
    """
    copy: Any = obj.copy()
    data: ObjectData = obj.data
    copy.data = mesh = data.copy()
    copy[_COPY_OF] = obj.name
    kept = {modifier.name for modifier in deforming_modifiers(obj)}
    try:
        # Handlers take it for no splats.
        for mark in (names.MARK, names.PLACES):
            if mark in mesh:
                del mesh[mark]
        for modifier in [modifier for modifier in copy.modifiers if modifier.name not in kept]:
            copy.modifiers.remove(modifier)
        copy.hide_viewport = False
        bpy.context.scene.collection.objects.link(copy)
        if getattr(mesh, "shape_keys", None) is not None:
            _apply_keys(copy)
        yield copy
    finally:
        bpy.data.objects.remove(copy)
        bpy.data.meshes.remove(mesh)


def _apply_keys(copy: Any) -> None:
    switched = [modifier for modifier in copy.modifiers if modifier.show_viewport]
    for modifier in switched:
        modifier.show_viewport = False
    bpy.context.view_layer.update()
    mixed = read_positions(copy.evaluated_get(bpy.context.evaluated_depsgraph_get()).data)
    copy.shape_key_clear()
    write_positions(copy.data, mixed)
    for modifier in switched:
        modifier.show_viewport = True


def _evaluated(copy: Any, points: Array) -> Array:
    write_positions(copy.data, points)
    copy.update_tag()
    bpy.context.view_layer.update()
    found = read_positions(copy.evaluated_get(bpy.context.evaluated_depsgraph_get()).data)
    if len(found) != len(points):
        raise InputError(
            f"'{copy[_COPY_OF]}' has {len(points)} splats, and its modifiers make {len(found)} points of them; "
            "remove the modifier that does."
        )
    return found.astype(np.float64)
