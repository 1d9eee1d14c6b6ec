# SPDX-License-Identifier: GPL-3.0-or-later
"""GSkin's buttons in the side bar: found where they are drawn, clicked by the mouse, waited for."""

from __future__ import annotations

import time
from collections.abc import Generator

import bpy
from addon import working
from arriving import PANELS
from stage import Hands, Stage, View, Wait

ROW, COLUMNS = 16, (0.3, 0.7)
"""Pixels from a row of the search to the next, less than a button is high; where across the side bar it looks."""
MOMENTS = (0.04, 0.15)
"""Seconds that Blender is given at each place to notice the mouse; the longer where it was too busy."""
ASIDE = (0, -16, 16, -8, 8)
"""Pixels above and below where a button was noticed, at which it may be: Blender may have noticed it late."""
STEADY = 4
"""Times that a button may have moved before it is clicked."""

Place = tuple[int, int]


class Buttons:
    """The buttons of GSkin's tab. All panels have to be open at first (`arrive`); `show` keeps those that are
    needed, as if the others were not there, so that there is nothing to scroll for."""

    def __init__(self, stage: Stage, hands: Hands, view: View) -> None:
        self.stage, self.hands, self.view = stage, hands, view
        self._known: dict[str, Place] = {}

    def show(self, *names: str) -> Generator[Wait, None, None]:
        """Only these of `PANELS`, below the main one."""
        for name in PANELS:
            panel = getattr(bpy.types, f"GSKIN_PT_{name}", None) or _hidden.get(name)
            if panel.is_registered and name not in names:
                _hidden[name] = panel
                bpy.utils.unregister_class(panel)
            elif not panel.is_registered and name in names:
                bpy.utils.register_class(panel)
        self._known.clear()
        self.view.area.tag_redraw()
        yield 0.5

    def find(self, name: str) -> Generator[Wait, None, Place | None]:
        """Where the button of an operator, or the field of a property by its name, is and stays; None where it is
        not."""
        self.view.region("UI").tag_redraw()
        yield self.stage.pause(0.5)
        for _ in range(STEADY):
            place = yield from self._find(name)
            if place is None:
                return None
            # What was done last may still change the panel above.
            yield self.stage.pause(0.5)
            yield from self.hands.move(place[0] + 1, place[1])
            if self.under_mouse() == name:
                return place
        return None

    def _find(self, name: str) -> Generator[Wait, None, Place | None]:
        for moment in (0.0, *MOMENTS):
            if moment:
                yield from self._search(name, moment)
            x, y = self._known.get(name, (0, 0))
            for off in ASIDE if name in self._known else ():
                yield from self.hands.move(x, y + off)
                yield self.stage.soon(lambda: self.under_mouse() == name, 0.4)
                if self.under_mouse() == name:
                    self._known[name] = x, y + off
                    return x, y + off
        return None

    def press(self, operator: str, what: str, wait: float = 30.0) -> Generator[Wait, None, bool]:
        """Click a button and wait until its operator is done; whether it is, `what` in words for the checks."""
        place = yield from self.find(operator)
        self.stage.check(f"the button {what} is found", place is not None, place)
        if place is None:
            return False
        before, chapter = finished(), self.stage.chapter
        self.stage.chapter = f"button {what}"
        began = time.monotonic()
        yield from self.hands.click(*place)
        yield self.stage.soon(lambda: finished() != before and not working(), wait)
        self.stage.numbers[f"{what} s"] = time.monotonic() - began
        self.stage.note_pauses(self.stage.chapter, what)
        self.stage.chapter = chapter
        done = finished()
        good = done != before and last_name() == operator
        self.stage.check(f"{what} runs to its end", good, last_name())
        self.view.area.tag_redraw()
        yield self.stage.pause(0.5)
        if not good:
            yield from self.hands.shoot_screen(f"x_{operator}")
        return good

    def under_mouse(self) -> str:
        """The operator or the property whose button the mouse is on, as "gskin.try_it"; empty for none."""
        manager = bpy.context.window_manager
        manager.clipboard = ""
        with self.view.override("UI"):
            if bpy.ops.ui.copy_python_command_button.poll():
                bpy.ops.ui.copy_python_command_button()
                return manager.clipboard.removeprefix("bpy.ops.").partition("(")[0]
            if bpy.ops.ui.copy_data_path_button.poll():
                bpy.ops.ui.copy_data_path_button()
        return manager.clipboard

    def _search(self, name: str, moment: float) -> Generator[Wait, None, None]:
        """Move the mouse up the side bar, scrolled to its end, until a button is met."""
        self._known.clear()
        window, region = self.view.window, self.view.region("UI")
        yield from self.hands.move(region.x + region.width // 2, self.view.middle()[1])
        yield from self.hands.wheel(25)
        yield 0.5
        for y in range(window.height - region.y - 8, window.height - region.y - region.height + 40, -ROW):
            for share in COLUMNS:
                x = region.x + round(share * region.width)
                window.cursor_warp(x, window.height - y)
                yield moment
                found = self.under_mouse()
                if found:
                    self._known.setdefault(found, (x, y))
            if name in self._known:
                return


_hidden: dict[str, type] = {}
"""Panels that are not shown now."""


def finished() -> tuple[int, ...]:
    """The operators that a person can look back on: another one more when one is done."""
    return tuple(operator.as_pointer() for operator in bpy.context.window_manager.operators)


def last_name() -> str:
    """The operator that was done last, as "gskin.try_it"."""
    operators = bpy.context.window_manager.operators
    return operators[-1].bl_idname.lower().replace("_ot_", ".") if operators else ""
