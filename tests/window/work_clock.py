# SPDX-License-Identifier: GPL-3.0-or-later
"""What a piece of work costs an artist: the time of the hand and the machine's, step by step."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import bpy
from stage import Stage, Story, View

SPEED = 300.0
"""Pixels a second of a hand that draws around something with care."""
VIEW, CLICK, KEY, TURN = 1.5, 2.0, 0.5, 3.0
"""Seconds allowed to the hand: another view and back to the figure; to a button and a click; a key; a bone's turn."""


class Step(NamedTuple):
    """Seconds of the hand, from the end of its doing until the result is drawn, and of processor time meanwhile."""

    what: str
    hand: float
    machine: float
    processor: float


class WorkClock:
    """Collects the steps; `until_drawn` waits for the machine's part of one."""

    def __init__(self, stage: Stage, view: View) -> None:
        self.stage, self.view = stage, view
        self.steps: list[Step] = []
        self._drawn, self._spent = 0.0, time.process_time()
        bpy.types.SpaceView3D.draw_handler_add(self._note, (), "WINDOW", "POST_PIXEL")

    def _note(self) -> None:
        self._drawn = time.monotonic()

    def until_drawn(
        self, what: str, hand: float, began: float, done: Callable[[], bool] = lambda: True, wait: float = 60.0
    ) -> Story:
        """Wait until something that the hand ended at `began` is done and drawn, and note the step."""
        yield self.stage.soon(done, wait)
        over = time.monotonic()
        self.view.area.tag_redraw()
        yield self.stage.soon(lambda: self._drawn > over, wait)
        spent, self._spent = self._spent, time.process_time()
        step = Step(what, hand, self._drawn - began, self._spent - spent)
        self.steps.append(step)
        seen = f"hand {hand:.1f} s, machine {step.machine:.2f} s, {step.processor:.2f} s of processor time"
        print(f"      {what}: {seen}", flush=True)

    def begin(self) -> None:
        """What was done up to now costs no step anything."""
        self._spent = time.process_time()

    def total(self, first: str) -> Step:
        """The sums of all steps from the one called `first` on."""
        rest = self.steps[[step.what for step in self.steps].index(first) :]
        return Step("work", *(sum(step[column] for step in rest) for column in (1, 2, 3)))


def drawing(points: list[tuple[int, int]]) -> float:
    """Seconds that a hand takes for a stroke through points of the screen."""
    return sum(((x - a) ** 2 + (y - b) ** 2) ** 0.5 for (a, b), (x, y) in pairwise(points)) / SPEED
