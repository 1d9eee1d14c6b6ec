# SPDX-License-Identifier: GPL-3.0-or-later
"""What operators share whose work comes in slices and ends in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

from ..core.errors import GSkinError
from ..scene.steps import Steps, run_for, run_to_end
from ._ticking import begin_ticking, end_ticking

TICK = 0.1
"""Seconds between two looks at the work."""
BUDGET = 0.05
"""Seconds of slices in each."""


class Sliced:
    """Mixin of an operator: `work` does it and returns the sentence to say, if any. `begin` runs it: at once for
    scripts and without a window, else between redraws, where Esc cancels."""

    bl_label: str
    report: Callable[[set[str], str], None]

    cancelled = "Cancelled; nothing was changed"
    """What is said after Esc."""
    asked = False
    """Whether a person clicked, in a window."""
    _steps: Steps[Any] | None = None
    _timer: bpy.types.Timer | None = None

    def work(self, context: bpy.types.Context) -> Steps[Any]:
        """The work; what it raises as GSkinError is said."""
        raise NotImplementedError

    def begin(self, context: bpy.types.Context, *, modal: bool = False) -> set[str]:
        """For `execute`, and where the operator is `modal` already, for that."""
        # What is done again from Adjust Last Operation is the same operator, and nobody clicked.
        asked, self.asked = self.asked, False
        try:
            self._steps = self.work(context)
        except GSkinError as error:
            return self._failed(error)
        if asked and not bpy.app.background and context.window is not None:
            return begin_ticking(self, context, TICK, modal=modal)
        try:
            result = run_to_end(self._steps)
        except GSkinError as error:
            self._leave(context)
            return self._failed(error)
        self._leave(context)
        return self._said(context, result)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC" and event.value == "PRESS":
            self._leave(context)
            self.report({"WARNING"}, self.cancelled)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}  # nobody may change the splats meanwhile
        try:
            share = run_for(self._steps, BUDGET)
        except StopIteration as stop:
            self._leave(context)
            return self._said(context, stop.value)
        except GSkinError as error:
            self._leave(context)
            return self._failed(error)
        except Exception:
            # Blender frees the operator without a word to it; its mode and status text would stay.
            self._leave(context)
            raise
        if context.workspace is not None:
            context.workspace.status_text_set(f"{self.bl_label}: {share:.0%}  (Esc cancels)")
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is loaded, the window closes."""
        if self._steps is not None:
            self._steps.close()

    def _said(self, context: bpy.types.Context, sentence: Any) -> set[str]:
        """The end; `sentence` is what `work` returned."""
        if sentence:
            self.report({"INFO"}, sentence)
        return {"FINISHED"}

    def _failed(self, error: GSkinError) -> set[str]:
        self.report({"ERROR"}, error.plain)
        return {"CANCELLED"}

    def _leave(self, context: bpy.types.Context) -> None:
        if self._steps is not None:
            self._steps.close()
        end_ticking(self, context)
        if context.workspace is not None:
            context.workspace.status_text_set(None)


class SlicedClick(Sliced):
    """The same for an operator that begins with the click."""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.asked = True
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.begin(context)
