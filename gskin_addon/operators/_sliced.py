# SPDX-License-Identifier: GPL-3.0-or-later
"""What operators share whose work comes in slices and ends in one sentence."""

from __future__ import annotations

from collections.abc import Callable

import bpy

from ..core.errors import GSkinError
from ..scene.steps import Steps, run_for, run_to_end

TICK = 0.1
"""Seconds between two looks at the work."""
BUDGET = 0.05
"""Seconds of slices in each."""


class Sliced:
    """Mixin of an operator: `work` does it and returns the sentence to say, if any. `begin` runs it: at once for
    scripts and without a window, else between redraws, where Esc cancels."""

    bl_label: str
    report: Callable[[set[str], str], None]

    asked = False
    """Whether a person clicked, in a window."""
    _steps: Steps[str] | None = None
    _timer: bpy.types.Timer | None = None

    def work(self, context: bpy.types.Context) -> Steps[str]:
        """The work; what it raises as GSkinError is said."""
        raise NotImplementedError

    def begin(self, context: bpy.types.Context, *, modal: bool = False) -> set[str]:
        """For `execute`, and where the operator is `modal` already, for that."""
        self._steps = self.work(context)
        # What is done again from Adjust Last Operation is the same operator, and nobody clicked.
        asked, self.asked = self.asked, False
        if not asked or bpy.app.background or context.window is None:
            try:
                return self._said(run_to_end(self._steps))
            except GSkinError as error:
                return self._failed(error)
        self._timer = context.window_manager.event_timer_add(TICK, window=context.window)
        if not modal:
            operator: object = self
            context.window_manager.modal_handler_add(operator)  # type: ignore[arg-type]
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC" and event.value == "PRESS":
            self._leave(context)
            self.report({"WARNING"}, "Cancelled; nothing was changed")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}  # nobody may change the splats meanwhile
        try:
            share = run_for(self._steps, BUDGET)
        except StopIteration as stop:
            self._leave(context)
            return self._said(stop.value)
        except GSkinError as error:
            self._leave(context)
            return self._failed(error)
        except Exception:
            self._leave(context)
            raise
        if context.workspace is not None:
            context.workspace.status_text_set(f"{self.bl_label}: {share:.0%}  (Esc cancels)")
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is loaded, the window closes."""
        if self._steps is not None:
            self._steps.close()

    def _said(self, sentence: str) -> set[str]:
        if sentence:
            self.report({"INFO"}, sentence)
        return {"FINISHED"}

    def _failed(self, error: GSkinError) -> set[str]:
        self.report({"ERROR"}, error.plain)
        return {"CANCELLED"}

    def _leave(self, context: bpy.types.Context) -> None:
        if self._steps is not None:
            self._steps.close()
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
        if context.workspace is not None:
            context.workspace.status_text_set(None)
