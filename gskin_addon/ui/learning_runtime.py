# SPDX-License-Identifier: GPL-3.0-or-later
"""How the learning runtime is drawn, in the preferences and in the panel."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.worker.runtime_client import RuntimeClient
from ..session import learning_runtime
from .progress import wrap

_TAIL = 6


def draw_runtime(layout: bpy.types.UILayout, context: bpy.types.Context, *, manage: bool = False) -> None:
    """Draw the installation that runs, or how the runtime is and the click that mends it.

    manage: also what a healthy runtime can be asked, repair and removal, as the preferences show it.
    """
    width = context.region.width if context.region is not None else 500
    client = learning_runtime.state.client
    if client is not None:
        _draw_installation(layout, client, width)
        return
    if learning_runtime.state.removal is not None:
        _draw_text(layout, "Removing the learning runtime ...", "TIME", width)
        return
    outcome = learning_runtime.state.outcome
    if outcome and (manage or learning_runtime.state.failed):
        _draw_text(layout, outcome, "ERROR" if learning_runtime.state.failed else "INFO", width)
        if learning_runtime.state.failed:
            _draw_log(layout, learning_runtime.state.log)
    status = learning_runtime.status(context)
    remedy = learning_runtime.remedy(context)
    if remedy is not None:
        icon = {"missing": "INFO", "outdated": "INFO"}.get(status.state, "ERROR")
        _draw_text(layout, remedy.sentence, icon, width)
        layout.operator(remedy.operator, text=remedy.label, icon="IMPORT")
    elif manage:
        _draw_text(layout, status.sentence, "CHECKMARK" if status.usable else "TIME", width)
    if manage and status.state != "missing":
        row = layout.row(align=True)
        row.operator("gskin.repair_runtime", icon="TOOL_SETTINGS")
        row.operator("gskin.install_runtime", text="Change...", icon="PREFERENCES")
        row.operator("gskin.remove_runtime", text="Remove...", icon="TRASH")


def _draw_installation(layout: bpy.types.UILayout, client: RuntimeClient, width: int) -> None:
    event = client.progress
    layout.progress(factor=event.fraction, text=f"{event.fraction:.0%}  {event.stage.capitalize()}")
    _draw_text(layout, "Stopping ..." if client.cancelling else event.message, "TIME", width)
    _draw_log(layout, list(client.log))
    layout.operator("gskin.cancel_runtime", icon="X")


def _draw_text(layout: bpy.types.UILayout, text: str, icon: Any, width: int) -> None:
    column = layout.column(align=True)
    for part in wrap(text, width):
        column.label(text=part, icon=icon)
        icon = "BLANK1"


def _draw_log(layout: bpy.types.UILayout, lines: list[str]) -> None:
    """The log's last lines."""
    if not lines:
        return
    column = layout.box().column(align=True)
    column.active = False
    for line in lines[-_TAIL:]:
        column.label(text=line.strip()[:120])
