# SPDX-License-Identifier: GPL-3.0-or-later
"""How the running job, or the outcome of the last one, is drawn."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

from ..core.job.progress_text import time_left
from ..scene.bone_frames import armature_of
from ..scene.compared import compared
from ..scene.proxy_object import followed_armature
from ..session import live_pictures
from ..session.confidence import spread_of
from ..session.running_job import state
from .translations import BUTTON, tr

SURE_AT_ALL = 0.995
"""From this share on, that nearly all splats are sure at all says nothing."""


def draw(layout: bpy.types.UILayout, width: int) -> None:
    """Draw the running job with its bar, or the last one's outcome, wrapped at about `width` pixels."""
    job = state.job
    if job is not None:
        event = job.progress
        layout.progress(factor=event.fraction, text=f"{event.fraction:.0%}  {_time_left(job.seconds_left)}")
        layout.label(text="Stopping ..." if job.cancelling else event.message or event.stage.capitalize())
        if job.pictures is not None:
            _draw_pictures(layout, live_pictures.icons(job.pictures))
        for name, value in event.losses.items():
            row = layout.row()
            row.active = False
            row.label(text=name)
            row.label(text=f"{value:.4g}")
        layout.operator("gskin.cancel_auto_skin", icon="X")
    elif state.outcome:
        box = layout.box().column(align=True)
        icon: Any = "ERROR" if state.failed else "INFO"
        for text in wrap(tr(state.outcome), width):
            box.label(text=text, icon=icon)
            icon = "BLANK1"
        if state.details:
            box.label(text="The details are in the system console", icon="BLANK1")


def _draw_pictures(layout: bpy.types.UILayout, pictures: list[tuple[str, int]]) -> None:
    """The newest pictures of the running job side by side, with their names."""
    row = layout.row() if pictures else layout
    for name, icon in pictures:
        column = row.column()
        column.template_icon(icon_value=icon, scale=7.0)
        column.label(text=name)


def draw_posing(layout: bpy.types.UILayout, splats: bpy.types.Object | None) -> None:
    """The way to the rig that moves the splats; nothing where none does, or where it is being posed."""
    armature = None if splats is None else followed_armature(splats)
    if armature is not None and armature.mode != "POSE":
        layout.operator("gskin.pose_rig", icon="POSE_HLT")
    if splats is not None and armature_of(splats) is not None:
        row = layout.row(align=True)
        row.operator("gskin.try_it", icon="PLAY")
        row.operator("gskin.test_poses", text="", icon="ASSET_MANAGER")


def draw_comparison(layout: bpy.types.UILayout, splats: bpy.types.Object | None) -> None:
    """The two sides of the weights, the shown one pressed in; nothing where there is nothing to compare with."""
    now = None if splats is None else compared(splats)
    if now is None:
        return
    name, shown = now
    row = layout.row(align=True)
    before = tr("Bone heat", BUTTON) if name == "bone heat" else tr("Initial weights", BUTTON)
    for side, text in (("before", before), ("result", tr("Learned", BUTTON))):
        row.operator("gskin.compare_weights", text=text, depress=shown == side).show = side.upper()
    row.operator("gskin.blend_weights", text="", icon="OVERLAY")


def draw_confidence(layout: bpy.types.UILayout, splats: bpy.types.Object | None) -> None:
    """How sure the least sure splats are and how sure half of them is, and clicks that show the former.

    Nothing where no splat knows, or where the weights that are shown are those from before learning.
    """
    spread = None if splats is None else spread_of(splats)
    now = None if spread is None else compared(splats)
    if spread is None or (now is not None and now[1] == "before"):
        return
    column = layout.box().column(align=True)
    if spread.sure < SURE_AT_ALL:
        column.label(text=tr("{share} of the splats are sure").format(share=f"{spread.sure:.0%}"))
    else:
        column.label(text="How sure the weights are")
    for share, below in spread.worst.items():
        row = column.row(align=True)
        text = tr("Least sure {share}: below {bound}").format(share=f"{share:.0%}", bound=f"{below:.0%}")
        row.progress(factor=below, text=text)
        select = row.operator("gskin.select_unsure_splats", text="", icon="RESTRICT_SELECT_OFF")
        select.worst, select.below = 100 * share, 0.0
    half = tr("Half of them: above {bound}").format(bound=f"{spread.median:.0%}")
    column.progress(factor=spread.median, text=half)


def _time_left(seconds: float | None) -> str:
    words = time_left(seconds)
    if seconds is None:
        return tr("estimating time")
    return tr("{time} left").format(time=words.removesuffix(" left"))


def wrap(text: str, width: int) -> list[str]:
    """`text` in lines that fit about `width` pixels: labels do not wrap by themselves."""
    scale = bpy.context.preferences.system.ui_scale
    return textwrap.wrap(text, max(20, int(width / (7.5 * scale))))
