# SPDX-License-Identifier: GPL-3.0-or-later
"""The check list in GSkin's panel: what was looked at, what is in the way, and the click that mends it."""

from __future__ import annotations

from typing import Any

import bpy

from ..session import learning_runtime, readiness
from . import progress
from .learning_runtime import draw_runtime
from .translations import tr

_ICONS = {"ok": "CHECKMARK", "warn": "INFO", "stop": "ERROR"}


def draw(context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
    """One line where all is well, else the list of all checks."""
    width = context.region.width if context.region is not None else 300
    checks = readiness.checks(context)
    box = layout.box()
    head = box.row()
    bad = [check for check in checks if check.state != "ok"]
    stops = any(check.state == "stop" for check in bad)
    head.label(text=_summary(len(bad), stops), icon=_icon("stop" if stops else "warn" if bad else "ok"))
    head.operator("gskin.check_again", text="", icon="FILE_REFRESH", emboss=False)
    if bad:
        for check in checks:
            _draw_check(box, check, width)
    if learning_runtime.state.client is not None:
        draw_runtime(box, context)


def _summary(count: int, stops: bool) -> str:
    if not count:
        return tr("Ready")
    if count == 1:
        return tr("1 thing to mend") if stops else tr("1 thing to look at")
    return (tr("{count} things to mend") if stops else tr("{count} things to look at")).format(count=count)


def _draw_check(layout: bpy.types.UILayout, check: readiness.Check, width: int) -> None:
    column = layout.column(align=True)
    if check.state == "ok":
        column.active = False
        column.label(text=check.name, icon=_icon("ok"))
        return
    icon = _icon(check.state)
    for text in progress.wrap(tr(check.sentence), width):
        column.label(text=text, icon=icon)
        icon = "BLANK1"
    if check.operator:
        button = column.operator(check.operator, text=check.label)
        for name, value in check.options:
            setattr(button, name, value)


def _icon(state: str) -> Any:
    return _ICONS[state]
