# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigged splats into the file that the command line names."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .console import print_message

if TYPE_CHECKING:
    import bpy


def save_rigged(out: Path, obj: bpy.types.Object) -> None:
    """Write the splats with their armature as .glb, or the whole file as .blend. Raises GSkinError."""
    from ..scene import rig_files

    if out.suffix.lower() == ".glb":
        from ..scene.gltf_export import export_glb

        for sentence in export_glb(out, [obj]):
            print_message(f"Warning: {sentence}")
    else:
        rig_files.save_blend(out)
