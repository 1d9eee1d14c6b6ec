# SPDX-License-Identifier: GPL-3.0-or-later
"""How the running job, or the outcome of the last one, is drawn."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

from ..core.job.progress_text import time_left
from ..scene.compared import compared
from ..session.confidence import spread_of
from ..session.running_job import state

SURE_AT_ALL = 0.995
"""From this share on, that nearly all splats are sure at all says nothing."""


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
    """How sure the least sure splats are and how sure half of them is, and clicks that show the former.

    Nothing where no splat knows, or where the weights that are shown are those from before learning.
    """
    spread = None if splats is None else spread_of(splats)
    now = None if spread is None else compared(splats)
    if spread is None or (now is not None and now[1] == "before"):
        return
    column = layout.box().column(align=True)
    sure = f"{spread.sure:.0%} of the splats are sure" if spread.sure < SURE_AT_ALL else "How sure the weights are"
    column.label(text=sure)
    for share, below in spread.worst.items():
        row = column.row(align=True)
        row.progress(factor=below, text=f"Least sure {share:.0%}: below {below:.0%}")
        select = row.operator("gskin.select_unsure_splats", text="", icon="RESTRICT_SELECT_OFF")
        select.worst, select.below = 100 * share, 0.0
    column.progress(factor=spread.median, text=f"Half of them: above {spread.median:.0%}")


def wrap(text: str, width: int) -> list[str]:
    """`text` in lines that fit about `width` pixels: labels do not wrap by themselves."""
    scale = bpy.context.preferences.system.ui_scale
    return textwrap.wrap(text, max(20, int(width / (7.5 * scale))))
