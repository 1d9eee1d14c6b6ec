# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigged splats into the file that the command line names."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..core.splats.cloud import SplatCloud
from ..core.splats.formats import left_out
from ..core.splats.gltf_file import UP as GLTF_UP
from .console import print_message

if TYPE_CHECKING:
    import bpy


def save_rigged(out: Path, obj: bpy.types.Object) -> None:
    """Write the splats with their armature as .glb, or the whole file as .blend. Raises GSkinError."""
    from ..scene import rig_files
    from ..scene.deform_stack import shown_wrongly
    from ..scene.placement import as_in_file
    from ..scene.splat_object import read_cloud

    if out.suffix.lower() == ".glb":
        from ..scene.gltf_export import export_glb

        for sentence in export_glb(out, [obj]):
            print_message(f"Warning: {sentence}")
        say_left_out(out, as_in_file(obj, read_cloud(obj), GLTF_UP))
    else:
        rig_files.save_blend(out)
        for sentence in shown_wrongly(obj):
            print_message(f"Warning: {sentence}")


def say_left_out(out: Path, cloud: SplatCloud) -> None:
    """Warn of what the written file does not hold. cloud: with the file's axes."""
    for words in left_out(out, cloud):
        print_message(f"Warning: '{out}': {words}.")
