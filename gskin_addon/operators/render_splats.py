# SPDX-License-Identifier: GPL-3.0-or-later
"""Render Splats: a still or the animation from the scene's camera, as true splats, into the output path."""

from __future__ import annotations

import sys

import bpy

from ..core.errors import Cancelled, GSkinError
from ..core.job.progress_text import ProgressPrinter
from ..scene.drawn import rendered_splats
from ..session import running_job, status_bar
from ..session.preferences import job_python, worker_python
from ..session.render_job import RenderJob
from ..session.render_settings import render_settings
from ._ticking import begin_ticking, end_ticking

TICK = 0.05
"""Seconds between two looks at the process that draws."""


class GSKIN_OT_render_splats(bpy.types.Operator):
    """Render the visible splats from the scene's camera into the output path, while Blender goes on"""

    bl_idname = "gskin.render_splats"
    bl_label = "Render Splats"

    animation: bpy.props.BoolProperty(
        name="Animation",
        description="All frames of the scene; off, the present one",
        default=False,
        options={"SKIP_SAVE"},
    )

    _job: RenderJob | None = None
    _timer: bpy.types.Timer | None = None

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if running_job.state.job is not None:
            cls.poll_message_set("Another job is running; wait for it or cancel it")
        elif context.scene.camera is None:
            cls.poll_message_set("The scene has no camera; add one (Add > Camera)")
        elif not rendered_splats(context.view_layer):
            cls.poll_message_set("No splats are visible to renders")
        else:
            return True
        return False

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start, and come back by a timer."""
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
            return {"PASS_THROUGH"}
        try:
            if self._job.step():
                status_bar.show(context)
                return {"PASS_THROUGH"}
        except GSkinError as error:
            return self._end(context, error)
        except Exception:
            # Blender frees the operator without a word to it; the panel must not go on saying that it runs.
            self._job.close()
            self._leave(context)
            running_job.end("Rendering stopped on a fault of its own; the system console says where", failed=True)
            raise
        return self._end(context)

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is loaded, the window closes."""
        self._job.cancel()
        self._job.close()
        self._leave(context)
        running_job.end("")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Without a window, and for scripts: render to the end, progress printed."""
        if not self._start(context):
            return {"CANCELLED"}
        try:
            self._job.wait(ProgressPrinter("lines", sys.stdout))
        except GSkinError as error:
            return self._end(context, error)
        except KeyboardInterrupt:
            return self._end(context, Cancelled("Rendering was cancelled."))
        return self._end(context)

    def _start(self, context: bpy.types.Context) -> bool:
        python, _ = worker_python(context)  # with numba, which is faster
        problem = ""
        if python is None:
            python, problem = job_python(context, False)
        if python is None:
            self.report({"ERROR"}, problem)
            return False
        chosen = render_settings(context.scene)
        options = {"animation": self.animation, "hold_out": chosen.hold_out, "depth": chosen.depth}
        options["on_gpu"] = chosen.on_gpu and not bpy.app.background
        try:
            self._job = RenderJob.start(context.scene, context.view_layer, python, **options)
        except GSkinError as error:
            running_job.end(error.plain, failed=True)
            self.report({"ERROR"}, error.plain)
            return False
        running_job.begin(self._job)
        return True

    def _end(self, context: bpy.types.Context, error: GSkinError | None = None) -> set[str]:
        sentence = self._job.close()
        self._leave(context)
        if error is None:
            running_job.end(sentence)
            self.report({"INFO"}, sentence)
            return {"FINISHED"}
        stopped = isinstance(error, Cancelled)
        running_job.end(f"{error.plain} {sentence}." if stopped else error.plain, failed=not stopped)
        self.report({"WARNING" if stopped else "ERROR"}, error.plain)
        return {"CANCELLED"}

    def _leave(self, context: bpy.types.Context) -> None:
        end_ticking(self, context)
        status_bar.clear(context)


CLASSES = (GSKIN_OT_render_splats,)
