# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin pose`: rigged splats in another pose, as .blend or posed .ply; or as .glb with their actions."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ..core.errors import InputError
from ..core.splats.formats import write_splats
from .blender import require_bpy
from .console import print_message
from .paths import check_output, same_file

if TYPE_CHECKING:
    import bpy


def run(options: argparse.Namespace) -> None:
    """Do it. Raises InputError for what cannot be used."""
    check_output(options.out, "--out", (".blend", ".glb", ".ply"))
    if same_file(options.source, options.out):
        raise InputError(f"--out '{options.out}' would overwrite its own input; choose another name.")
    obj = open_posed(options)
    from ..scene import rig_files
    from ..scene.placement import as_in_file
    from ..scene.posing import posed_cloud

    if options.out.suffix.lower() == ".ply":
        write_splats(options.out, as_in_file(obj, posed_cloud(obj), options.ply_up or ""))
    elif options.out.suffix.lower() == ".glb":
        from ..scene.gltf_export import export_glb

        export_glb(options.out, [obj])
    else:
        rig_files.save_blend(options.out)
    print_message(f"'{obj.name}' is posed in '{options.out}'.")


def open_posed(options: argparse.Namespace) -> bpy.types.Object:
    """Open the .blend of the options and pose it as they say; the splat object."""
    turns = parse_turns(options.rotate)
    require_bpy()
    import bpy

    from ..scene import rig_files
    from ..scene.posing import turn_bones
    from ..scene.proxy_object import followed_armature

    if options.source.suffix.lower() != ".blend":
        raise InputError(f"'{options.source}' is no .blend; give one that `gskin rig` wrote.")
    rig_files.open_blend(options.source)
    obj = rig_files.find_splats(options.source, options.object)
    armature = followed_armature(obj)
    wanted = turns or options.action or options.frame is not None
    if armature is None:
        if wanted:
            raise InputError(f"'{obj.name}' in '{options.source}' follows no armature; bind it with gskin rig.")
        return obj
    if options.action is not None:
        _assign_action(armature, options.action)
    if options.frame is not None:
        whole, part = divmod(options.frame, 1.0)
        bpy.context.scene.frame_set(int(whole), subframe=part)
    if turns:
        # An action would take the turned bones back at the next change of frame.
        if armature.animation_data is not None and armature.animation_data.action is not None:
            armature.animation_data.action.use_fake_user = True
            armature.animation_data.action = None
        turn_bones(armature, turns)
    bpy.context.view_layer.update()
    return obj


def parse_turns(given: list[list[str]]) -> dict[str, tuple[float, float, float]]:
    """Bone -> rotation vector in degrees, from --rotate BONE X Y Z. InputError for what is no number."""
    turns: dict[str, tuple[float, float, float]] = {}
    for bone, *numbers in given:
        try:
            x, y, z = (float(number) for number in numbers)
        except ValueError:
            raise InputError(
                f"--rotate {bone} {' '.join(numbers)}: the angles must be three numbers in degrees."
            ) from None
        turns[bone] = (x, y, z)
    return turns


def _assign_action(armature: bpy.types.Object, name: str) -> None:
    import bpy

    action: bpy.types.Action | None = bpy.data.actions.get(name)
    if action is None:
        names = ", ".join(f"'{found.name}'" for found in bpy.data.actions) or "none"
        raise InputError(f"There is no action '{name}'; the file has {names}.")
    data = armature.animation_data or armature.animation_data_create()
    data.action = action
    # From Blender 4.4 an action holds slots, one per animated thing.
    if hasattr(data, "action_slot") and data.action_slot is None and len(action.slots):
        data.action_slot = action.slots[0]
