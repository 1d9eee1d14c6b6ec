# SPDX-License-Identifier: GPL-3.0-or-later
"""Try It: it plays, ends, leaves the pose as it was, paints what stretches, selects the worst of it; Esc stops it."""

from __future__ import annotations

import time

import bpy
import numpy as np
from addon import rest, working
from arriving import choose
from stage import Story

from .desk import Desk

MOST = 0.02
"""Part of the splats that is selected at most."""


def trying(desk: Desk) -> Story:
    """Once to the end, once stopped."""
    stage = desk.stage
    stage.chapter = "try"
    rest(desk.rig)
    choose(desk.view, desk.splats, desk.rig)
    desk.look()
    yield from desk.buttons.show()
    place = yield from desk.buttons.find("gskin.try_it")
    stage.check("the button Try It is found", place is not None, place)
    if place is None:
        return
    before = pose(desk)
    stage.chapter = "button Try It"
    began = time.monotonic()
    yield from desk.hands.click(*place)
    yield stage.soon(working, 5.0)
    seen = [before]
    shots = {5: "w11_try", 12: "w12_try"}

    def note(*_: object) -> None:
        seen.append(pose(desk))

    bpy.app.handlers.depsgraph_update_post.append(note)
    while working():
        due = [count for count in shots if len(seen) > count]
        if due:
            yield from desk.hands.shoot(shots.pop(due[0]))
        yield 0.05
    bpy.app.handlers.depsgraph_update_post.remove(note)
    stage.numbers["Try It s"] = time.monotonic() - began
    stage.note_pauses(stage.chapter, "Try It")
    stage.chapter = "try"
    different = {one.tobytes() for one in seen}
    stage.check("Try It plays many poses", len(different) > 20, len(different))
    moved = (np.array(seen) != before).any(axis=(0, 2, 3))
    stage.check("most bones turn", moved.mean() > 0.7, f"{moved.sum()} of {len(moved)}")
    stage.check("Try It leaves the pose as it was, to the bit", np.array_equal(pose(desk), before))
    stage.check("and no key", desk.rig.animation_data is None or desk.rig.animation_data.action is None)
    stage.check("Try It shows what stretches", desk.overlay() == "STRETCH", desk.overlay())
    stretch, selected = desk.value("STRETCH"), desk.selected()
    good = stretch is not None and stretch.max() > 0.2
    stage.check("Try It finds splats that stretch", good, None if stretch is None else f"{stretch.max():.2f}")
    share = float(selected.mean())
    stage.check("Try It selects some splats", 0 < share <= MOST + 1e-4, f"{selected.sum():,}, {share:.2%}")
    if stretch is not None and selected.any():
        least, most = float(stretch[selected].min()), float(stretch[~selected].max())
        stage.check("they are the worst", least >= most - 1e-3, f"{least:.2f} and more, others up to {most:.2f}")
    yield from desk.settled()
    yield from desk.hands.shoot("w13_tried")
    yield from desk.tab("EDIT")
    stage.check("Tab shows them selected", np.array_equal(desk.selected(), selected), f"{desk.selected().sum():,}")
    yield from desk.hands.shoot("w14_worst")
    yield from desk.tab("OBJECT")
    yield from stopped(desk, before)


def stopped(desk: Desk, before: np.ndarray) -> Story:
    """Esc in the middle."""
    stage = desk.stage
    choose(desk.view, desk.splats, desk.rig)
    yield 0.5
    place = yield from desk.buttons.find("gskin.try_it")
    if place is None:
        stage.check("the button Try It is found again", False)
        return
    yield from desk.hands.click(*place)
    yield stage.soon(lambda: not np.array_equal(pose(desk), before), 20.0)
    played = not np.array_equal(pose(desk), before)
    yield from desk.keys("Escape")
    yield stage.soon(lambda: not working(), 5.0)
    stage.check("Esc stops Try It", played and not working())
    stage.check("the pose is as it was, to the bit", np.array_equal(pose(desk), before))


def pose(desk: Desk) -> np.ndarray:
    """(bones, 4, 4) each bone's own turn."""
    return np.array([np.array(bone.matrix_basis) for bone in desk.rig.pose.bones])
