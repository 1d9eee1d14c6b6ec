# SPDX-License-Identifier: GPL-3.0-or-later
"""Auto-Skin Gaussians: give the chosen splats weights for the chosen armature."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import bpy
from numpy.typing import NDArray

from ..core.errors import Cancelled, GSkinError, InputError
from ..core.guidance.options import check_models
from ..core.job.progress_text import ProgressPrinter
from ..core.job.settings import JobSettings
from ..scene.blender_splats import make_riggable
from ..scene.bone_frames import armature_of
from ..scene.cleanup import begin_selecting
from ..scene.compared import compared, is_edited, is_kept_edited
from ..scene.handlers import is_unsettled, iter_settle, settle
from ..scene.steps import Steps, run_for
from ..scene.weight_edits import selected_splats
from ..session import running_job, status_bar
from ..session.chosen import chosen_armature, chosen_blender_splats, chosen_splats, panel_settings, proxy_mesh
from ..session.preferences import job_python
from ..session.readiness import what_is_missing
from ..session.skin_job import SkinJob
from ._ticking import begin_ticking, end_ticking

Array = NDArray[Any]

TICK = 0.1
"""Seconds between two looks at the worker."""

WRITING = 0.05
"""Seconds of each TICK in which weights are written; the rest is Blender's."""


class SkinOperator:
    """Mixin of the operators that run a job: started by `invoke`, watched by a timer, written in slices."""

    report: Callable[[set[str], str], None]
    bl_label: str

    # Not REGISTER: a change in the "adjust last operation" box would start the whole job again.
    bl_options = {"UNDO"}

    _job: SkinJob | None = None
    _timer: bpy.types.Timer | None = None
    _writing: Steps[str] | None = None

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        problem = what_is_missing(context)
        if problem:
            cls.poll_message_set(problem)  # type: ignore[attr-defined]
        return not problem

    def chosen_rows(self, context: bpy.types.Context) -> Array | None:
        """Splats (N,) bool whose weights may change; None for all. Raises InputError."""
        return None

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start the job and come back to it by a timer: Blender stays free meanwhile."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        if not self._start(context):
            return {"CANCELLED"}
        return begin_ticking(self, context, TICK)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC" and event.value == "PRESS":
            self._job.cancel()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            # While the weights are written nobody may change the splats: clicks and keys wait that second.
            return {"PASS_THROUGH"} if self._writing is None else {"RUNNING_MODAL"}
        try:
            if self._writing is None:
                if self._job.step():
                    status_bar.show(context)
                    return {"PASS_THROUGH"}
                self._writing = self._job.apply_steps()
            return self._write(context)
        except GSkinError as error:
            return self._fail(context, error)
        except Exception:
            # Blender frees the operator without a word to it; the panel must not go on saying that it runs.
            self._job.cancel()
            self._leave(context)
            running_job.end("Auto-Skin stopped on a fault of its own; the system console says where", failed=True)
            raise

    def _write(self, context: bpy.types.Context) -> set[str]:
        """Some slices of the weights; nothing is in the scene before the last."""
        if self._job.cancelling:
            return self._fail(context, Cancelled("The job was cancelled."))
        try:
            share = run_for(self._writing, WRITING)
        except StopIteration as stop:
            return self._finish(context, stop.value)
        self._job.progress = replace(self._job.progress, message=f"Writing the weights ({share:.0%})")
        status_bar.show(context)
        return {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is loaded, the window closes."""
        self._job.cancel()
        self._leave(context)
        running_job.end("")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Without a window, and for scripts: run the job to its end, progress printed."""
        if not self._start(context):
            return {"CANCELLED"}
        try:
            self._job.wait(ProgressPrinter("lines", sys.stdout))
            return self._finish(context, self._job.apply())
        except GSkinError as error:
            return self._fail(context, error)
        except KeyboardInterrupt:
            return self._fail(context, Cancelled("The job was cancelled."))

    def _start(self, context: bpy.types.Context) -> bool:
        chosen = panel_settings(context)
        settings = chosen.as_job()
        python, _ = job_python(context, chosen.needs_runtime())
        try:
            _take_over(context)
            only = self.chosen_rows(context)
            JobSettings.parse(settings)
            check_models(settings["guidance"], settings.get("options", {}))
            self._job = SkinJob.start(
                chosen_splats(context),
                chosen_armature(context),
                settings,
                python,
                None if only is not None else proxy_mesh(context),
                allow_download=chosen.models.may_download(),
                only=only,
                paintable=chosen.paintable,
            )
        except GSkinError as error:
            self._fail(context, error)
            return False
        running_job.begin(self._job)
        return True

    def _finish(self, context: bpy.types.Context, sentence: str) -> set[str]:
        self._leave(context)
        running_job.end(sentence)
        self.report({"INFO"}, sentence)
        return {"FINISHED"}

    def _fail(self, context: bpy.types.Context, error: GSkinError) -> set[str]:
        self._leave(context)
        details = getattr(error, "traceback", "")
        running_job.end(error.plain, failed=not isinstance(error, Cancelled), details=details)
        if isinstance(error, Cancelled):
            self.report({"WARNING"}, error.plain)
        else:
            if details:
                print(details)
            self.report({"ERROR"}, error.plain)
        return {"CANCELLED"}

    def _leave(self, context: bpy.types.Context) -> None:
        if self._writing is not None:
            self._writing.close()
            self._writing = None
        end_ticking(self, context)
        status_bar.clear(context)


def _take_over(context: bpy.types.Context) -> None:
    """Make splats of Blender's riggable, as the check list says. Raises InputError for what is in the way then."""
    splats = chosen_blender_splats(context)
    if splats is None:
        return
    make_riggable(context, splats)
    if not bpy.app.background:  # a step of its own: it stays where the job is cancelled
        bpy.ops.ed.undo_push(message="Make Riggable")
    problem = what_is_missing(context)
    if problem:
        raise InputError(f"{problem}.")


class GSKIN_OT_auto_skin(SkinOperator, bpy.types.Operator):
    """Learn skinning weights for the splats, and let them follow the armature"""

    bl_idname = "gskin.auto_skin"
    bl_label = "Auto-Skin Gaussians"

    confirmed: bpy.props.BoolProperty(options={"HIDDEN", "SKIP_SAVE"})

    _settling: Steps[None] | None = None
    """Changed weights that are taken over before the job starts."""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """As a job starts; weights that were changed by hand are asked about first."""
        splats = chosen_splats(context)
        watched = not bpy.app.background and context.window is not None
        if splats is not None and is_unsettled(splats):
            # A hand's last change may not have been noticed yet.
            if watched:
                self._settling = iter_settle(splats)
                return begin_ticking(self, context, TICK)
            settle(splats)
        if watched and self._asks(splats):
            return {"CANCELLED"}
        return super().invoke(context, event)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self._settling is None:
            return super().modal(context, event)
        if event.type == "ESC" and event.value == "PRESS":
            return self._give_up(context)
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        try:
            run_for(self._settling, WRITING)
        except StopIteration:
            self._settling = None
        except Exception:
            self._give_up(context)
            raise
        else:
            return {"RUNNING_MODAL"}
        if self._asks(chosen_splats(context)):
            self._leave(context)
            return {"CANCELLED"}
        return {"RUNNING_MODAL"} if self._start(context) else {"CANCELLED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is loaded, the window closes."""
        if self._settling is None:
            super().cancel(context)
        else:
            self._give_up(context)

    def _asks(self, splats: bpy.types.Object | None) -> bool:
        """Whether the other operator asks first, and starts this one again."""
        asks = not self.confirmed and splats is not None and _has_hand_work(splats)
        if asks:
            _ours().auto_skin_again("INVOKE_DEFAULT")
        return asks

    def _give_up(self, context: bpy.types.Context) -> set[str]:
        if self._settling is not None:
            self._settling.close()
            self._settling = None
        self._leave(context)
        return {"CANCELLED"}


class GSKIN_OT_auto_skin_again(bpy.types.Operator):
    """Ask before new weights take the place of weights that were changed by hand"""

    bl_idname = "gskin.auto_skin_again"
    bl_label = "Weights were changed by hand"
    bl_options = {"INTERNAL"}

    which: bpy.props.EnumProperty(
        name="New Weights for",
        description="The splats that get new weights",
        items=[
            ("ALL", "All Splats", "But for locked vertex groups"),
            ("SELECTED", "Selected Splats", "The others, and locked vertex groups, stay to the bit"),
        ],
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Any:
        return context.window_manager.invoke_props_dialog(self, width=380)

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.prop(self, "which", expand=True)
        column.label(text="Locked vertex groups stay. Compare Weights brings back what was", icon="INFO")
        splats = chosen_splats(context)
        if splats is not None and is_edited(splats) and is_kept_edited(splats):
            column.label(text="What was changed on the other side of Compare Weights is lost", icon="ERROR")

    def execute(self, context: bpy.types.Context) -> set[str]:
        selected = self.which == "SELECTED"
        started: Any = (
            _ours().refine_selected("INVOKE_DEFAULT")
            if selected
            else _ours().auto_skin("INVOKE_DEFAULT", confirmed=True)
        )
        return {"FINISHED"} if "RUNNING_MODAL" in started else {"CANCELLED"}


class GSKIN_OT_refine_selected(SkinOperator, bpy.types.Operator):
    """Run the job for the selected splats alone: other splats and locked groups stay to the bit, and a guidance starts
    from the weights that are there"""

    bl_idname = "gskin.refine_selected"
    bl_label = "Refine Selected"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        problem = what_is_missing(context, in_edit_mode=True)
        if not problem and armature_of(chosen_splats(context)) != chosen_armature(context):
            problem = "Select splats that follow the armature by weights of their own"
        if problem:
            cls.poll_message_set(problem)
        return not problem

    def chosen_rows(self, context: bpy.types.Context) -> Array | None:
        splats = chosen_splats(context)
        selected = selected_splats(splats)
        if not selected.any():
            raise InputError(f"No splats of '{splats.name}' are selected; select some in Edit Mode (Tab).")
        begin_selecting(context, splats)
        return selected


class GSKIN_OT_cancel_auto_skin(bpy.types.Operator):
    """Stop the running job; the same job started again goes on where it was"""

    bl_idname = "gskin.cancel_auto_skin"
    bl_label = "Cancel"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return running_job.state.job is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        running_job.state.job.cancel()
        return {"FINISHED"}


def _has_hand_work(splats: bpy.types.Object) -> bool:
    """Whether new weights would take the place of hand work: of what is shown, or of a result that is only out of sight
    while Compare Weights shows what was before it."""
    now = compared(splats)
    return is_edited(splats) or (is_kept_edited(splats) and now is not None and now[1] == "before")


def _ours() -> Any:
    return bpy.ops.gskin  # type: ignore[attr-defined]  # what is registered here


CLASSES = (GSKIN_OT_auto_skin, GSKIN_OT_auto_skin_again, GSKIN_OT_refine_selected, GSKIN_OT_cancel_auto_skin)
