# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin pose`: rigged splats in another pose, as .blend or posed splats; or as .glb with their actions."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ..core.errors import InputError
from ..core.splats.formats import FILE_TYPES, output_format, write_splats
from ..core.splats.gltf_file import UP as GLTF_UP
from .blender import require_bpy
from .console import print_message
from .paths import check_output, same_file
from .save import save_rigged, say_left_out

if TYPE_CHECKING:
    import bpy

SPLATS = tuple(suffix for suffix in FILE_TYPES if suffix not in (".glb", ".gltf"))
"""Endings of files of posed splats without a rig."""


def run(options: argparse.Namespace) -> None:
    """Do it. Raises InputError for what cannot be used."""
    check_output(options.out, "--out", (".blend", ".glb", *SPLATS))
    if same_file(options.source, options.out):
        raise InputError(f"--out '{options.out}' would overwrite its own input; choose another name.")
    kind = options.out.suffix.lower()
    with posed(options) as obj:
        from ..scene.placement import as_in_file
        from ..scene.posing import posed_cloud
        from ..scene.splat_object import read_cloud

        if kind in SPLATS:
            form = output_format(options.out)
            cloud = as_in_file(obj, posed_cloud(obj), options.up or form.up)
            write_splats(options.out, cloud, up=form.up)
            say_left_out(options.out, cloud)
        elif kind == ".glb":
            from ..scene.gltf_export import export_glb

            still = options.rotate or options.set or options.action or options.frame is not None
            for sentence in export_glb(options.out, [obj], posed=bool(still)):
                print_message(f"Warning: {sentence}")
            say_left_out(options.out, as_in_file(obj, read_cloud(obj), GLTF_UP))
    if kind == ".blend":
        save_rigged(options.out, obj)
    print_message(f"'{obj.name}' is posed in '{options.out}'.")


@contextmanager
def posed(options: argparse.Namespace) -> Iterator[bpy.types.Object]:
    """Open the .blend of the options and pose it as they say; gives the splat object.

    Inside the block splats and rig are evaluated even where the file has switched them off.
    """
    turns = parse_turns(options.rotate)
    settings = parse_settings(options.set)
    require_bpy()
    from ..scene import rig_files
    from ..scene.anchored import proxy_of
    from ..scene.blend_rigs import check_whole, own_rig
    from ..scene.handlers import refresh_all
    from ..scene.proxy_object import followed_armature
    from ..scene.still_pose import Pose, pose_still
    from ..scene.visibility import shown

    if options.source.suffix.lower() != ".blend":
        raise InputError(f"'{options.source}' is no .blend; give one that `gskin rig` wrote.")
    rig_files.open_blend(options.source)
    refresh_all()  # a Blender without the add-on may have saved it
    obj = rig_files.find_splats(options.source, options.object)
    armature = followed_armature(obj)
    if armature is not None:
        check_whole(armature)
    if options.slot is not None and options.action is None:
        raise InputError(f"--slot '{options.slot}' is of no use without --action.")
    wanted = Pose(turns, settings, options.action, options.slot, options.frame)
    if armature is None and wanted:
        raise InputError(f"'{obj.name}' in '{options.source}' follows no armature; bind it with gskin rig.")
    if armature is not None and wanted and armature.library is not None and options.out.suffix.lower() == ".blend":
        name = armature.library.filepath
        armature = own_rig(armature)
        print_message(f"Armature '{armature.name}' was linked from '{name}'; it is the file's own now.")
    drawn = getattr(options, "engine", "") == "cycles"
    with shown([obj], render=drawn), shown([obj, proxy_of(obj), armature], select=True):
        if armature is not None:
            for note in pose_still(obj, armature, wanted):
                print_message(f"{note[:1].upper()}{note[1:]}.")
        yield obj


def parse_turns(given: list[list[str]]) -> dict[str, tuple[float, float, float]]:
    """Bone -> rotation vector in degrees, from --rotate BONE X Y Z. InputError for what is no number."""
    turns: dict[str, tuple[float, float, float]] = {}
    for bone, *numbers in given:
        try:
            x, y, z = (finite(number) for number in numbers)
        except ValueError:
            raise InputError(
                f"--rotate {bone} {' '.join(numbers)}: the angles must be three numbers in degrees."
            ) from None
        turns[bone] = (x, y, z)
    return turns


def finite(text: str) -> float:
    """A number that is neither infinite nor NaN. Raises ValueError."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def parse_settings(given: list[list[str]]) -> list[tuple[str, str, float]]:
    """Bone, property and value, from --set BONE PROPERTY VALUE. InputError for what is no number."""
    settings = []
    for bone, prop, text in given:
        try:
            settings.append((bone, prop, finite(text)))
        except ValueError:
            raise InputError(f"--set {bone} {prop} {text}: the value must be a number.") from None
    return settings
