# SPDX-License-Identifier: GPL-3.0-or-later
"""Try It: the rig plays through its range, and the splats that stretch most are marked."""

from __future__ import annotations

import time
from typing import Any

import bpy

from ..core.errors import GSkinError
from ..core.skinning.edits.stretch import StretchMeter
from ..scene.handlers import iter_settle
from ..scene.overlay import show_stretch
from ..scene.selecting import mark_selected
from ..scene.steps import Steps, run_for, run_to_end
from ..scene.trial import Player, Trial, iter_meter
from ..session.chosen import chosen_splats
from ._rig_and_splats import can_pose_splats
from ._ticking import begin_ticking, end_ticking
from .confidence import least

TICK = 1 / 30
"""Seconds between two poses, where the machine can."""
BUDGET = 0.02
"""Seconds of slices in each before the first pose."""


class GSKIN_OT_try_it(bpy.types.Operator):
    """Play every limb through its range in the view and mark the splats that stretch most. Esc stops it; the pose is
    afterwards what it was, and no key is set"""

    bl_idname = "gskin.try_it"
    bl_label = "Try It"
    bl_options = {"REGISTER", "UNDO"}

    poses: bpy.props.EnumProperty(
        name="Poses",
        description="What is played",
        items=[
            ("RANGE", "Range of Limbs", "Every limb from one end of its range to the other"),
            ("LIBRARY", "Pose Library", "The pose assets of this rig in the file"),
        ],
        default="RANGE",
    )
    beyond: bpy.props.FloatProperty(
        name="Marked From",
        description="Splats are marked whose way to a neighbour becomes so many times as long",
        default=2.0,
        min=1.0,
        soft_max=5.0,
    )
    most: bpy.props.FloatProperty(
        name="At Most",
        description="No more than this part of the splats is marked: those that stretch most",
        default=2.0,
        min=0.0,
        max=100.0,
        precision=1,
        subtype="PERCENTAGE",
    )
    seconds: bpy.props.FloatProperty(
        name="Seconds", description="How long it plays", default=10.0, min=1.0, soft_max=60.0, options={"SKIP_SAVE"}
    )

    again: bpy.props.BoolProperty(options={"HIDDEN", "SKIP_SAVE"})
    """Whether it is done once more with another number; the poses have been measured then."""

    _trial: Trial | None = None
    _making: Steps[StretchMeter] | None = None
    """What is needed before the first pose."""
    _timer: bpy.types.Timer | None = None
    _player: Player
    _began = 0.0

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return can_pose_splats(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """All of it at once: without a window, and again with another number."""
        splats = chosen_splats(context)
        known = _last.get(splats.data.session_uid) if self.again else None
        library = self.poses == "LIBRARY"
        if known is not None and known.library == library and len(known.stretch) == len(splats.data.vertices):
            self._trial = known
            return self._tell(context)
        try:
            self._trial = Trial(splats, run_to_end(_prepare(splats)), library=library)
            for _ in self._trial.run():
                pass
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        return self._tell(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        self._making = _prepare(chosen_splats(context))
        if context.workspace is not None:
            context.workspace.status_text_set("Trying the rig  (Esc stops)")
        return begin_ticking(self, context, TICK)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC" and event.value == "PRESS":
            self._leave(context)
            self.report({"INFO"}, "Stopped; the pose is as it was")
            return {"CANCELLED"}
        if event.type != "TIMER":
            # Looking around is welcome; posing and editing meanwhile are not.
            looks = event.type in {"MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "MOUSEMOVE"}
            return {"PASS_THROUGH"} if looks else {"RUNNING_MODAL"}
        try:
            if self._making is not None:
                return self._make(context)
            if self._player.step(time.monotonic() - self._began):
                return {"RUNNING_MODAL"}
            self._leave(context)
            return self._tell(context)
        except Exception:
            # Blender frees the operator without a word to it; the pose would stay as it is.
            self._leave(context)
            raise

    def _make(self, context: bpy.types.Context) -> set[str]:
        """Some slices of what is needed, and with the last the trial begins."""
        try:
            run_for(self._making, BUDGET)
        except StopIteration as stop:
            self._making = None
            try:
                self._trial = Trial(chosen_splats(context), stop.value, library=self.poses == "LIBRARY")
            except GSkinError as error:
                return self._refuse(context, error)
            self._trial.begin()
            self._player, self._began = Player(self._trial, self.seconds), time.monotonic()
        except GSkinError as error:
            return self._refuse(context, error)
        return {"RUNNING_MODAL"}

    def _refuse(self, context: bpy.types.Context, error: GSkinError) -> set[str]:
        self._leave(context)
        self.report({"ERROR"}, error.plain)
        return {"CANCELLED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is loaded, the window closes."""
        if self._making is not None:
            self._making.close()
        if self._trial is not None:
            self._trial.end()

    def _leave(self, context: bpy.types.Context) -> None:
        if self._making is not None:
            self._making.close()
            self._making = None
        end_ticking(self, context)
        if context.workspace is not None:
            context.workspace.status_text_set(None)
        if self._trial is not None:
            self._trial.end()

    def _tell(self, context: bpy.types.Context) -> set[str]:
        trial: Any = self._trial
        splats = chosen_splats(context)
        show_stretch(splats, trial.stretch)
        far = trial.stretch > self.beyond
        marked = far & least(-trial.stretch, self.most / 100)
        mark_selected(splats, marked)
        words = f"{far.sum():,} of {len(far):,} splats stretch to more than {self.beyond:.1f} times"
        if far.sum() > marked.sum():
            words += f", the {marked.sum():,} worst to more than {float(trial.stretch[marked].min(initial=9e9)):.1f}"
        worst = ", ".join(f"'{name}'" for name in trial.to_blame(marked))
        often = f"; most in {worst}" if trial.library else f"; most where {worst} turn"
        often = often if worst else ""
        self.report({"INFO"}, f"{words}{often}; Tab shows them selected" if marked.any() else words)
        _last.clear()
        _last[splats.data.session_uid] = trial
        self._trial, self.again = None, True
        return {"FINISHED"}


def _prepare(splats: bpy.types.Object) -> Steps[StretchMeter]:
    """What a trial needs, in slices."""
    yield from iter_settle(splats)
    return (yield from iter_meter(splats))


_last: dict[int, Trial] = {}
"""The last trial, by session id of the splats' mesh."""


CLASSES = (GSKIN_OT_try_it,)
