# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that follow an armature: parent, Armature modifier, and for splats the nodes that turn them."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.errors import InputError
from . import names
from .bone_frames import armature_modifier, ensure_bone_frames, has_bendy_bones
from .node_groups import find_display
from .probes import follow_stack
from .rotation_nodes import add_rotation, rotation_steps
from .splat_object import is_splat_object, refuse_edit_mode
from .steps import Steps
from .transforms import world_similarity


def bind(obj: bpy.types.Object, armature: bpy.types.Object) -> bpy.types.Object:
    """Let the splats of `obj` follow `armature`: `follow`, then the rotation nodes; gives the bone frames.

    Weights are untouched. Raises InputError: no splats, no armature, Edit Mode, uneven scale.
    """
    check_splats(obj)
    frames = ensure_bone_frames(armature)
    add_rotation(obj, frames, follow(obj, armature))
    follow_stack(obj)
    return frames


def iter_prepare(armature: bpy.types.Object) -> Steps[bpy.types.NodeTree]:
    """Make in slices the nodes that `bind` gives splats, so that it need not make all of them at once."""
    return rotation_steps(bendy=has_bendy_bones(armature))


def check_splats(obj: bpy.types.Object) -> None:
    """Raises InputError where `obj` is no splat object that can follow an armature."""
    if not is_splat_object(obj):
        raise InputError(f"'{obj.name}' is no splat object; import a Gaussian splat .ply and select it.")
    refuse_edit_mode(obj)
    world_similarity(obj)


def follow(
    obj: bpy.types.Object, armature: bpy.types.Object, *, keep_parent: bool = False
) -> bpy.types.ArmatureModifier:
    """Let any mesh object follow `armature` by its vertex groups: parent (in place) and Armature modifier.

    Like Ctrl-P > Armature Deform, so that moving the armature object carries the mesh along.
    """
    every: list[Any] = [modifier for modifier in obj.modifiers if modifier.type == "ARMATURE"]
    modifier = next((m for m in every if m.object == armature), armature_modifier(obj))
    set_parent(obj, armature, keep_parent=keep_parent)
    if modifier is None:
        new: Any = obj.modifiers.new(names.ARMATURE_MODIFIER, "ARMATURE")
        modifier = new
        show_posed_in_edit_mode(modifier)
        # Behind whatever deforms the rest shape, before anything that draws.
        display = find_display(obj)
        if display is not None:
            obj.modifiers.move(obj.modifiers.find(modifier.name), obj.modifiers.find(display.name))
    modifier.object = armature
    modifier.use_vertex_groups, modifier.use_bone_envelopes = True, False
    # Dual quaternions would move the points in another way than Eq. 1.
    modifier.use_deform_preserve_volume = False
    return modifier


def show_posed_in_edit_mode(modifier: bpy.types.ArmatureModifier) -> None:
    """Edit Mode selects on the posed figure."""
    modifier.show_in_editmode = modifier.show_on_cage = True


def set_parent(obj: bpy.types.Object, armature: bpy.types.Object, *, keep_parent: bool = False) -> None:
    """Parent `obj` to the armature object, in place. With `keep_parent` an object that has a parent keeps it."""
    if obj.parent == armature or (keep_parent and obj.parent is not None):
        return
    bpy.context.view_layer.update()  # matrix_world lags behind what a script has set
    world = obj.matrix_world.copy()
    obj.parent, obj.parent_type = armature, "OBJECT"
    obj.matrix_parent_inverse = armature.matrix_world.inverted()
    obj.matrix_world = world
