# SPDX-License-Identifier: GPL-3.0-or-later
"""What is missing before Auto-Skin can run."""

from __future__ import annotations

import bpy

from . import learning_runtime
from .chosen import chosen_armature, chosen_splats, panel_settings
from .preferences import job_python, worker_python
from .running_job import state


def what_is_missing(context: bpy.types.Context) -> str:
    """What a person must do before Auto-Skin can run, or nothing. Quick: menus ask on every redraw."""
    if state.job is not None:
        return "Auto-Skin is running: wait for it or cancel it"
    splats = chosen_splats(context)
    if splats is None:
        return "No splats are chosen: import a Gaussian splat .ply, or select a splat object"
    armature = chosen_armature(context)
    if armature is None:
        return "No armature is chosen: add one, or select it"
    if not any(bone.use_deform for bone in armature.data.bones):
        return f"Armature '{armature.name}' has no deform bones: turn on Deform for some"
    if splats.mode == "EDIT" or armature.mode == "EDIT":
        return "An object is in Edit Mode: leave it (Tab)"
    return job_python(context, panel_settings(context).needs_runtime())[1]


def guidance_remedy(context: bpy.types.Context) -> learning_runtime.Remedy | None:
    """What keeps guidance from computing, and the click that mends it; None where a Python with torch is at hand."""
    return None if worker_python(context)[0] is not None else learning_runtime.remedy(context)
