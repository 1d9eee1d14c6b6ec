# SPDX-License-Identifier: GPL-3.0-or-later
"""How the running job, or the outcome of the last one, is drawn."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

from ..core.job.progress_text import time_left
from ..scene.compared import compared
from ..session.confidence import sure_share
from ..session.running_job import state


def draw(layout: bpy.types.UILayout, width: int) -> None:
    """Draw the running job with its bar, or the last one's outcome, wrapped at about `width` pixels."""
    job = state.job
    if job is not None:
        event = job.progress
        layout.progress(factor=event.fraction, text=f"{event.fraction:.0%}  {time_left(job.seconds_left)}")
        layout.label(text="Stopping ..." if job.cancelling else event.message or event.stage.capitalize())
        for name, value in event.losses.items():
            row = layout.row()
            row.active = False
            row.label(text=name)
            row.label(text=f"{value:.4g}")
        layout.operator("gskin.cancel_auto_skin", icon="X")
    elif state.outcome:
        box = layout.box().column(align=True)
        icon: Any = "ERROR" if state.failed else "INFO"
        for text in wrap(state.outcome, width):
            box.label(text=text, icon=icon)
            icon = "BLANK1"
        if state.details:
            box.label(text="The details are in the system console", icon="BLANK1")


def draw_comparison(layout: bpy.types.UILayout, splats: bpy.types.Object | None) -> None:
    """The two sides of the weights, the shown one pressed in; nothing where there is nothing to compare with."""
    now = None if splats is None else compared(splats)
    if now is None:
        return
    name, shown = now
    row = layout.row(align=True)
    for side, text in (("before", name[:1].upper() + name[1:]), ("result", "Learned")):
        row.operator("gskin.compare_weights", text=text, depress=shown == side).show = side.upper()


def draw_confidence(layout: bpy.types.UILayout, splats: bpy.types.Object | None) -> None:
    """A bar of how many splats have sure weights, and the click that shows the others; nothing where none knows."""
    share = None if splats is None else sure_share(splats)
    if share is None:
        return
    row = layout.row(align=True)
    row.progress(factor=share, text=f"{share:.0%} of the splats are sure")
    row.operator("gskin.select_unsure_splats", text="", icon="RESTRICT_SELECT_OFF")


def wrap(text: str, width: int) -> list[str]:
    """`text` in lines that fit about `width` pixels: labels do not wrap by themselves."""
    scale = bpy.context.preferences.system.ui_scale
    return textwrap.wrap(text, max(20, int(width / (7.5 * scale))))
