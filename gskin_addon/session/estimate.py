# SPDX-License-Identifier: GPL-3.0-or-later
"""How long the job of the present choices will take."""

from __future__ import annotations

import bpy

from ..core.job.settings import JobSettings
from ..core.pipeline.estimate import estimate_seconds, in_words
from ..scene.splat_object import splat_count
from .chosen import chosen_armature, chosen_splats, panel_settings, proxy_mesh


def expected_time(context: bpy.types.Context) -> str:
    """Such as "about 6 s"; nothing where nothing is chosen, or where it depends on a model of the user's."""
    splats, armature = chosen_splats(context), chosen_armature(context)
    if splats is None or armature is None:
        return ""
    chosen = panel_settings(context)
    mesh = "mesh.npz" if proxy_mesh(context) is not None else ""
    settings = JobSettings.parse({**chosen.as_job(), "options": {}, "mesh": mesh})
    bones = sum(bone.use_deform for bone in armature.data.bones)
    return in_words(estimate_seconds(settings, splat_count(splats), bones))
