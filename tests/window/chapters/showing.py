# SPDX-License-Identifier: GPL-3.0-or-later
"""Show: each colouring of the splats chosen in its menu; What Moves with This by a click on a splat."""

from __future__ import annotations

import bpy
import numpy as np
from addon import part, working
from arriving import choose
from stage import Story

from .desk import Desk

OVERLAYS = {"BONES": "w21_bones", "CONFIDENCE": "w22_confidence", "WEIGHTS": "w23_weights", "NONE": "w20_captured"}
"""What is chosen, one after the other, and its picture."""
BONE, FAR = "head", "foot.L"


def showing(desk: Desk) -> Story:
    """The menu Show from one to the next, then the eyedropper."""
    stage = desk.stage
    stage.chapter = "show"
    choose(desk.view, desk.splats, desk.rig)
    desk.choose(BONE)
    desk.look()
    yield from desk.buttons.show("display")
    for overlay, picture in OVERLAYS.items():
        place = yield from desk.buttons.find("gskin_overlay")
        stage.check("the field Show is found", place is not None, place)
        if place is None:
            return
        yield from chosen(desk, place, overlay)
        stage.check(f"Show {overlay.capitalize()} by its menu", desk.overlay() == overlay, desk.overlay())
        yield from desk.settled()
        yield from desk.hands.shoot(picture)
    yield from moves_with(desk)


def chosen(desk: Desk, place: tuple[int, int], overlay: str) -> Story:
    """Open the menu and go down to the wanted entry by the arrow keys, which begin above the first."""
    names = [name for name, *_ in part("scene.overlay").OVERLAYS]
    yield from desk.hands.click(*place)
    yield desk.stage.pause(0.6)
    if overlay == "BONES":
        yield from desk.hands.shoot("w24_menu")
    yield from desk.hands.keys(*["Down"] * (names.index(overlay) + 1), "Return")
    yield desk.stage.soon(lambda: desk.overlay() == overlay, 4.0)
    yield from desk.hands.move(*desk.view.middle())


def moves_with(desk: Desk) -> Story:
    """Click the eyedropper, then the figure's head."""
    stage = desk.stage
    stage.chapter = "moves with"
    place = yield from desk.buttons.find("gskin.show_moves_with")
    stage.check("the button What Moves with This is found", place is not None, place)
    if place is None:
        return
    yield from desk.hands.click(*place)
    yield stage.soon(working, 5.0)
    stage.check("What Moves with This waits for a splat", working())
    bone = desk.rig.pose.bones[BONE]
    target = desk.rig.matrix_world @ (0.5 * bone.head + 0.5 * bone.tail)
    yield from desk.hands.click(*desk.place(target))
    yield stage.soon(lambda: not working() and desk.overlay() == "ALIKE", 15.0)
    stage.check("a click on a splat shows what moves with it", desk.overlay() == "ALIKE", desk.overlay())
    if desk.overlay() != "ALIKE":
        yield from desk.hands.keys("Escape")
        return
    yield from desk.settled()
    yield from desk.hands.shoot("w25_moves_with")
    weights, alike = desk.weights(), desk.value("ALIKE")
    picked = bpy.context.window_manager.operators[-1].splat
    strongest = desk.bones[int(weights[picked].argmax())]
    stage.check("the splat under the mouse was meant", strongest == BONE, f"splat {picked} follows {strongest}")
    shared = np.minimum(weights, weights[picked]).sum(axis=1)
    off = float(np.abs(shared - alike).max())
    stage.check("the colours are the shares of common weights", off < 0.02, f"{off:.1e}")
    same, other = alike[weights[:, desk.column(BONE)] > 0.95], alike[weights[:, desk.column(FAR)] > 0.5]
    stage.check("the head moves with it, a foot does not", same.min() > 0.8 and other.max() < 0.1,
                f"{same.min():.2f} and more; {other.max():.2f} and less")  # fmt: skip
