# SPDX-License-Identifier: GPL-3.0-or-later
"""Presets of the job's settings, kept where Blender keeps its own."""

from __future__ import annotations

import bpy
from bl_operators.presets import AddPresetBase

FOLDER = "gskin/job"


class GSKIN_OT_job_preset_add(AddPresetBase, bpy.types.Operator):
    """Keep the present settings of Auto-Skin as a preset, or remove the one that is shown"""

    bl_idname = "gskin.job_preset_add"
    bl_label = "Add Auto-Skin Preset"
    preset_menu = "GSKIN_PT_job_presets"
    preset_subdir = FOLDER
    preset_defines = ["settings = bpy.context.scene.gskin"]
    preset_values = [
        f"settings.{name}" for name in ("preset", "init", "guidance", "front", "max_influences", "seed")
    ]


CLASSES = (GSKIN_OT_job_preset_add,)
