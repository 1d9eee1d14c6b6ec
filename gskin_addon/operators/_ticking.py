# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that go on while Blender does: a timer of their window calls `modal` again and again."""

from __future__ import annotations

from typing import Any

import bpy


def begin_ticking(
    operator: Any, context: bpy.types.Context, seconds: float, *, modal: bool = False
) -> set[str]:
    """Let a timer call the operator's `modal` every so many seconds; gives what `invoke` or `execute` returns then.

    modal: the operator is so already.
    """
    operator._timer = context.window_manager.event_timer_add(seconds, window=context.window)
    if not modal:
        context.window_manager.modal_handler_add(operator)
    return {"RUNNING_MODAL"}


def end_ticking(operator: Any, context: bpy.types.Context) -> None:
    """Take the timer away, where there is one."""
    if operator._timer is not None:
        context.window_manager.event_timer_remove(operator._timer)
        operator._timer = None
