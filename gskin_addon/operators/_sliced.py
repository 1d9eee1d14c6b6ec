# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that do their work in slices where there is a window, so that it goes on drawing meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

from ..core.errors import GSkinError
from ..scene.steps import Steps, run_for, run_to_end
from ..session.chosen import chosen_splats

TICK = 0.1
"""Seconds between two looks at the work."""
BUDGET = 0.05
"""Seconds of slices in each."""


class Sliced:
    """Mixin of an operator on the chosen splats: `begin` makes the steps, `finish` is told what they gave. It runs in
    the mode that the artist is in; nobody can change the splats meanwhile, and Escape leaves them as they are."""

    bl_options = {"REGISTER", "UNDO"}
    bl_label: str

    report: Callable[[set[str], str], None]

    _steps: Steps[int] | None = None
    _timer: bpy.types.Timer | None = None
    _mode = ""

    def begin(self, context: bpy.types.Context, splats: bpy.types.Object) -> Steps[int]:
        """The work. Edit Mode is left when it starts. Raises GSkinError: it cannot be done."""
        raise NotImplementedError

    def finish(self, context: bpy.types.Context, count: int) -> str:
        """The sentence about what was done; count: what the steps gave. Raises GSkinError."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        if not self._begin(context):
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(TICK, window=context.window)
        operator: Any = self
        context.window_manager.modal_handler_add(operator)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC" and event.value == "PRESS":
            self._leave(context)
            self.report({"WARNING"}, "Cancelled; no weights were changed")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}  # nobody may change the splats meanwhile
        try:
            share = run_for(self._steps, BUDGET)
        except StopIteration as stop:
            return self._end(context, stop.value, "")
        except GSkinError as error:
            return self._end(context, None, error.plain)
        except Exception:
            # Blender frees the operator without a word to it; its mode and status text would stay.
            self._leave(context)
            raise
        if context.workspace is not None:
            context.workspace.status_text_set(f"{self.bl_label}: {share:.0%}  (Esc cancels)")
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is loaded, the window closes."""
        self._steps.close()

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not self._begin(context):
            return {"CANCELLED"}
        try:
            return self._end(context, run_to_end(self._steps), "")
        except GSkinError as error:
            return self._end(context, None, error.plain)

    def _begin(self, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        self._mode = splats.mode
        try:
            self._steps = self.begin(context, splats)
        except GSkinError as error:
            self._restore(splats)
            self.report({"ERROR"}, error.plain)
            return False
        return True

    def leave_edit_mode(self, context: bpy.types.Context, splats: bpy.types.Object) -> None:
        """Weights and points can only be read and written outside it; it comes back at the end."""
        if splats.mode == "EDIT":
            context.view_layer.objects.active = splats
            bpy.ops.object.mode_set(mode="OBJECT")

    def _end(self, context: bpy.types.Context, count: int | None, trouble: str) -> set[str]:
        sentence = ""
        if count is not None:
            try:
                sentence = self.finish(context, count)
            except GSkinError as error:
                trouble = error.plain
        self._leave(context)
        if trouble:
            self.report({"ERROR"}, trouble)
            return {"CANCELLED"}
        self.report({"INFO"}, sentence)
        return {"FINISHED"}

    def _leave(self, context: bpy.types.Context) -> None:
        self._steps.close()
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
        if context.workspace is not None:
            context.workspace.status_text_set(None)
        splats = chosen_splats(context)
        if splats is not None:
            self._restore(splats)

    def _restore(self, splats: bpy.types.Object) -> None:
        if self._mode == "EDIT" and splats.mode == "OBJECT":
            bpy.ops.object.mode_set(mode="EDIT")
        self._mode = ""
