# SPDX-License-Identifier: GPL-3.0-or-later
"""Fit Human, Mark Landmark with another fit, and Import Skeleton, held to the skeleton that the figure has."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
from addon import part
from arriving import choose
from stage import Story

from .desk import Desk

JOINTS = {"spine": "hips", "head": None, **{f"{name}.{side}": f"{name}.{side}" for side in "LR"
          for name in ("upper_arm", "forearm", "hand", "thigh", "shin", "foot")}}  # fmt: skip
"""Bones of the fitted skeleton, and those of the figure whose heads are the same joints."""
MARK = "hand.L"


def skeletons(desk: Desk, rig_file: Path) -> Story:
    """The figure without a rig gets one three times."""
    stage, buttons = desk.stage, desk.buttons
    stage.chapter = "skeletons"
    truth, parents = joints_of(rig_file)
    size = float(np.linalg.norm(np.ptp(desk.points(), axis=0)))
    choose(desk.view, desk.splats)
    desk.look()
    yield from buttons.show("skeleton")
    if not (yield from buttons.press("gskin.fit_human", "Fit Human")):
        return
    yield from desk.settled()
    yield from desk.hands.shoot("w01_fit_human")
    first = errors(desk.rig, truth) / size
    backwards = errors(desk.rig, turned(truth)) / size
    stage.numbers["Fit Human: joints off, share of the size"] = float(first.mean())
    # To where this creature with a tail and horns looks is not clear without a word.
    off = f"{first.mean():.1%} of the size, {backwards.mean():.1%} with its sides taken for one another"
    stage.check("Fit Human: joints of one side or the other are there", min(first.mean(), backwards.mean()) < 0.1, off)
    mirrored = desk.rig.data.use_mirror_x
    stage.check("Fit Human: what is done on one side happens on the other", mirrored)
    yield from mark(desk, truth[MARK][1])
    bpy.data.objects.remove(desk.rig)
    choose(desk.view, desk.splats)
    if (yield from buttons.press("gskin.fit_human", "Fit Human again")):
        yield from desk.settled()
        yield from desk.hands.shoot("w03_fit_again")
        again = errors(desk.rig, truth) / size
        stage.numbers["Fit Human after a landmark: joints off"] = float(again.mean())
        off = f"{again.mean():.1%} of the size"
        stage.check("the landmark tells to where it looks, and where the arms are", again.mean() < 0.06, off)
        marked = part("scene.landmarks").read_landmarks(desk.splats)[MARK]
        after = float(np.linalg.norm(tip(desk.rig) - marked)) / size
        stage.check("the hand reaches the landmark", after < 0.03, f"{after:.1%} off")
    yield from imported(desk, truth, parents, size)
    for obj in [obj for obj in bpy.data.objects if obj.type in {"ARMATURE", "EMPTY"}]:
        bpy.data.objects.remove(obj)
    choose(desk.view, desk.splats)


def mark(desk: Desk, goal: np.ndarray) -> Story:
    """Splats of the left hand are selected by a box, and Left Hand chosen in the menu Mark Landmark."""
    stage, buttons = desk.stage, desk.buttons
    yield from desk.tab("EDIT")
    yield from desk.box(goal, 12, 12)
    middle = desk.points()[desk.selected()].mean(axis=0) if desk.selected().any() else np.zeros(3)
    stage.check("a box selects splats of the hand", desk.selected().any(), f"{desk.selected().sum():,}")
    above, below = (yield from buttons.find("gskin.fit_bird")), (yield from buttons.find("gskin.import_skeleton"))
    if above is None or below is None:
        stage.check("the menu Mark Landmark is found", False)
        return
    yield from desk.hands.click(above[0], (above[1] + below[1]) // 2)
    yield stage.pause(0.8)
    yield from desk.hands.shoot("w02_landmarks")
    number = part("core.skeleton.landmarks").NAMES.index(MARK)
    yield from desk.hands.keys(*["Down"] * (number + 1), "Return")
    read = part("scene.landmarks").read_landmarks
    yield stage.soon(lambda: read(desk.splats), 5.0)
    marks = read(desk.splats)
    stage.check("Mark Landmark marks the left hand", list(marks) == [MARK], list(marks))
    off = float(np.linalg.norm(marks[MARK] - middle)) if MARK in marks else 9.0
    stage.check("in the middle of the selected splats", off < 1e-3, f"{off:.1e} m")
    yield from desk.tab("OBJECT")


def imported(desk: Desk, truth: dict[str, Any], parents: dict[str, str], size: float) -> Story:
    """A text as RigNet writes it, y up and in centimetres, chosen in the file browser."""
    stage = desk.stage
    folder = stage.out / "skeletons"
    folder.mkdir()
    path = folder / "figure.txt"
    lines = [f"joints {name} {100 * x:.4f} {100 * z:.4f} {-100 * y:.4f}" for name, ((x, y, z), _) in truth.items()]
    lines += [f"hier {parent} {name}" for name, parent in parents.items() if parent]
    path.write_text("\n".join([*lines, f"root {next(name for name in truth if not parents[name])}"]) + "\n")
    for obj in [obj for obj in bpy.data.objects if obj.type == "ARMATURE"]:
        bpy.data.objects.remove(obj)
    choose(desk.view, desk.splats)
    bpy.context.preferences.view.filebrowser_display_type = "SCREEN"
    yield from desk.buttons.show("skeleton")
    place = yield from desk.buttons.find("gskin.import_skeleton")
    stage.check("the button Import Skeleton is found", place is not None)
    if place is None:
        return
    yield from desk.hands.click(*place)
    yield stage.soon(lambda: browser() is not None, 10.0)
    area = browser()
    stage.check("Import Skeleton opens the file browser", area is not None)
    if area is None:
        return
    yield stage.pause(1.0)
    area.spaces.active.params.directory = str(folder).encode()
    with bpy.context.temp_override(window=desk.view.window, area=area):
        bpy.ops.file.refresh()
    yield stage.pause(1.5)
    region = next(region for region in area.regions if region.type == "WINDOW")
    x, y = region.x + 80, bpy.context.window_manager.windows[0].height - (region.y + region.height) + 34
    yield from desk.hands.shoot_screen("w04_browser")
    yield from desk.hands.double_click(x, y)
    yield stage.soon(lambda: browser() is None and any(obj.type == "ARMATURE" for obj in bpy.data.objects), 15.0)
    yield stage.pause(1.0)
    rigs = [obj for obj in bpy.data.objects if obj.type == "ARMATURE"]
    stage.check("Import Skeleton brings an armature", len(rigs) == 1, len(rigs))
    if not rigs:
        yield from desk.hands.keys("Escape")
        return
    heads = {bone.name: np.array(rigs[0].matrix_world @ bone.head_local) for bone in rigs[0].data.bones}
    off = max(float(np.linalg.norm(heads[name] - ends[0])) if name in heads else 9.0 for name, ends in truth.items())
    stage.check("Import Skeleton guesses axes, unit and place", off < 0.03 * size, f"{off / size:.1%} of the size")
    yield from desk.hands.shoot("w05_imported")


def browser() -> Any:
    """The file browser, where it is open."""
    window = bpy.context.window_manager.windows[0]
    return next((area for area in window.screen.areas if area.type == "FILE_BROWSER"), None)


def joints_of(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """By bone of a rig's file: (head, tail) in the world, and its parent; the scene is left as it was."""
    before = set(bpy.data.objects)
    rig = part("scene.rig_files").import_armature(path)
    bones = [bone for bone in rig.data.bones if bone.use_deform]
    matrix = rig.matrix_world
    ends = {bone.name: (np.array(matrix @ bone.head_local), np.array(matrix @ bone.tail_local)) for bone in bones}
    parents = {bone.name: bone.parent.name if bone.parent and bone.parent.use_deform else "" for bone in bones}
    for obj in set(bpy.data.objects) - before:
        bpy.data.objects.remove(obj)
    return ends, parents


def errors(rig: Any, truth: dict[str, Any]) -> np.ndarray:
    """Metres from the heads of a fitted skeleton's bones to the same joints of the figure's own."""
    heads = {bone.name: np.array(rig.matrix_world @ bone.head_local) for bone in rig.data.bones}
    pairs = [(name, own) for name, own in JOINTS.items() if own and name in heads]
    assert len(pairs) > 10, sorted(heads)
    return np.array([np.linalg.norm(heads[name] - truth[own][0]) for name, own in pairs])


def turned(truth: dict[str, Any]) -> dict[str, Any]:
    """The same with left and right taken for one another."""
    return {f"{name[:-1]}{'LR'[name[-1] == 'L']}" if name[-2:] in (".L", ".R") else name: ends
            for name, ends in truth.items()}  # fmt: skip


def tip(rig: Any) -> np.ndarray:
    """Where the left hand ends: Rigify's bone is its palm, six tenths of the way to the fingertips."""
    bone = rig.data.bones[MARK]
    head, tail = np.array(rig.matrix_world @ bone.head_local), np.array(rig.matrix_world @ bone.tail_local)
    return head + (tail - head) / 0.6
