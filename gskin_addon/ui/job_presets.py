# SPDX-License-Identifier: GPL-3.0-or-later
"""The menu of job presets in the header of GSkin's panel."""

from __future__ import annotations

import bpy
from bl_ui.utils import PresetPanel


class GSKIN_PT_job_presets(PresetPanel, bpy.types.Panel):
    bl_label = "Auto-Skin Presets"
    preset_subdir = "gskin/job"
    preset_operator = "script.execute_preset"
    preset_add_operator = "gskin.job_preset_add"


CLASSES = (GSKIN_PT_job_presets,)
