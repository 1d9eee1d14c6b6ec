# SPDX-License-Identifier: GPL-3.0-or-later
"""The running job in Blender's status bar, and the redraw of the panels that show it."""

from __future__ import annotations

import bpy

from ..core.job.progress_text import time_left
from .running_job import state


def show(context: bpy.types.Context) -> None:
    """Bring panels and the status bar up to date."""
    job = state.job
    if job is not None and context.workspace is not None:
        word = "Stopping" if job.cancelling else job.progress.message or job.progress.stage
        text = f"{job.title}: {word} {job.progress.fraction:.0%}, {time_left(job.seconds_left)}  (Esc cancels)"
        if text == state.shown:
            return  # ten looks a second, but seldom news
        state.shown = text
        context.workspace.status_text_set(text)
    _redraw(context)


def clear(context: bpy.types.Context) -> None:
    """Give the status bar back."""
    state.job, state.shown = None, ""
    if context.workspace is not None:
        context.workspace.status_text_set(None)
    _redraw(context)


def _redraw(context: bpy.types.Context) -> None:
    # The side bar alone: drawing the view again ten times a second would make a large scene crawl.
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()
