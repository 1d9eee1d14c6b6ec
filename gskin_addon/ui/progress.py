# SPDX-License-Identifier: GPL-3.0-or-later
"""What is known of the running and the last job, and how it is drawn."""

from __future__ import annotations

import textwrap
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:
    from ..core.worker.client import ProgressEvent
    from ..operators.skin_job import SkinJob


@dataclass
class State:
    """The job that runs, if one does, and the last one's outcome in a sentence."""

    job: SkinJob | None = None
    outcome: str = ""
    failed: bool = False
    details: str = ""
    shown: str = ""


state = State()


def begin(job: SkinJob) -> None:
    """`job` runs from now on."""
    state.job, state.outcome, state.failed, state.details = job, "", False, ""


def end(outcome: str, *, failed: bool = False, details: str = "") -> None:
    """No job runs any more; `details` may be a traceback of the worker."""
    state.job, state.outcome, state.failed, state.details = None, outcome, failed, details


def stop() -> None:
    """Stop a running job because the add-on goes."""
    if state.job is not None:
        state.job.cancel()
    end("")


def show(context: bpy.types.Context) -> None:
    """Bring panels and the status bar up to date."""
    job = state.job
    if job is not None and context.workspace is not None:
        word = "Stopping" if job.cancelling else job.progress.message or job.progress.stage
        text = f"Auto-Skin: {word} {job.progress.fraction:.0%}, {time_left(job.seconds_left)}  (Esc cancels)"
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


class Printer:
    """Prints progress for a terminal: every stage, and a line every `interval` seconds."""

    def __init__(self, interval: float = 2.0) -> None:
        self._interval, self._stage, self._at = interval, "", 0.0

    def __call__(self, event: ProgressEvent) -> None:
        now = time.monotonic()
        if event.stage != self._stage or now - self._at >= self._interval:
            self._stage, self._at = event.stage, now
            print(line(event), flush=True)


def line(event: ProgressEvent) -> str:
    """A line of text about `event`, for a terminal."""
    losses = "  ".join(f"{name} {value:.4g}" for name, value in event.losses.items())
    words = [f"{event.fraction:4.0%}", event.stage, event.message, losses, time_left(event.seconds_left)]
    return "  ".join(word for word in words if word)


def time_left(seconds: float | None) -> str:
    """Remaining time as a person says it."""
    if seconds is None:
        return "estimating time"
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02} min left"
    return f"{whole // 60}:{whole % 60:02} left"


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
        icon = "ERROR" if state.failed else "INFO"
        for text in wrap(state.outcome, width):
            box.label(text=text, icon=icon)
            icon = "BLANK1"
        if state.details:
            box.label(text="The details are in the system console", icon="BLANK1")


def wrap(text: str, width: int) -> list[str]:
    """`text` in lines that fit about `width` pixels: labels do not wrap by themselves."""
    scale = bpy.context.preferences.system.ui_scale
    return textwrap.wrap(text, max(20, int(width / (7.5 * scale))))


def _redraw(context: bpy.types.Context) -> None:
    # The side bar alone: drawing the view again ten times a second would make a large scene crawl.
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()
