# SPDX-License-Identifier: GPL-3.0-or-later
"""The weight tools of the panel by clicks: Smooth, Sharpen, Flood, Follow Neighbours and To Bone on a selection in Edit
Mode, Mirror on all; what each must do, and what none may: leave the selection, touch locked groups, lose the sum."""

from __future__ import annotations

import numpy as np
from addon import part, turned_as_computed
from arriving import choose
from stage import Story

from .desk import Desk, near

BONE, LOCKED = "upper_arm.L", "chest"
"""The active bone, at whose joint splats are selected, and one near to it, whose group is locked."""
TOOLS = (("Smooth", "gskin.smooth_weights"), ("Sharpen", "gskin.sharpen_weights"), ("Flood", "gskin.flood_weights"),
         ("Follow Neighbours", "gskin.follow_neighbours"), ("To Bone", "gskin.assign_to_bone"))  # fmt: skip
SAMPLE = 300
"""Splats whose surroundings are looked at."""


def editing(desk: Desk) -> Story:
    """Splats at the shoulder, one tool after the other."""
    stage = desk.stage
    stage.chapter = "edit"
    choose(desk.view, desk.splats, desk.rig)
    desk.look()
    desk.choose(BONE)
    part("scene.posing").turn_bones(desk.rig, {"forearm.R": (0, 0, 30), BONE: (0, -15, 0)})
    desk.splats.vertex_groups[LOCKED].lock_weight = True
    yield from desk.buttons.show("weights")
    yield from desk.tab("EDIT")
    yield from desk.box(desk.rig.matrix_world @ desk.rig.pose.bones[BONE].head, 30, 30)
    selected = desk.selected()
    stage.check("a box selects splats at the shoulder", 50 < selected.sum() < len(selected) / 4, f"{selected.sum():,}")
    yield from desk.hands.shoot("w40_box")
    around = Around(desk, selected)
    for name, operator in TOOLS:
        before = desk.weights()
        if not (yield from desk.buttons.press(operator, name)):
            continue
        after = desk.weights()
        judge(desk, name, before, after, selected)
        meant(desk, name, before, after, selected, around)
        if name == "To Bone":
            yield from there_and_back(desk, name, before, after)
    yield from desk.tab("OBJECT")
    yield from desk.settled()
    stage.check("rotations follow the tools", turned_as_computed(desk.splats))
    yield from desk.hands.shoot("w41_edited")
    yield from mirror(desk)
    desk.splats.vertex_groups[LOCKED].lock_weight = False


def mirror(desk: Desk) -> Story:
    """The right side gets the weights of the left one, with what was just done to its shoulder."""
    stage, splats = desk.stage, desk.splats
    splats.vertex_groups[LOCKED].lock_weight = False
    before, points = desk.weights(), desk.points()
    if not (yield from desk.buttons.press("gskin.mirror_weights", "Mirror")):
        return
    after = desk.weights()
    stage.check("Mirror changes splats", (after != before).any(), f"{(after != before).any(axis=1).sum():,}")
    stage.check("Mirror: the mode stays", splats.mode == "OBJECT")
    check_sums(desk, "Mirror", before, after)
    arm = [desk.column(f"{name}.R") for name in ("upper_arm", "forearm", "hand")]
    right = np.flatnonzero((points[:, 0] < -0.15) & (after[:, arm].sum(axis=1) > 0.2))[:: max(1, len(points) // 20_000)]
    right = right[:SAMPLE]
    partner = near(points[right] * [-1, 1, 1], points)
    swap = [desk.column(swapped(name)) for name in desk.bones]
    gaps = [np.abs(one[right][:, swap] - one[partner]).sum(axis=1).mean() for one in (before, after)]
    stage.check("the right arm is as the left one", gaps[1] < 0.5 * gaps[0], f"{gaps[0]:.3f} apart, now {gaps[1]:.3f}")
    left = points[:, 0] > 0.15
    stage.check("the left one stays", np.array_equal(after[left], before[left]))
    yield from desk.settled()
    stage.check("rotations follow Mirror", turned_as_computed(splats))
    yield from desk.hands.shoot("w42_mirrored")
    yield from there_and_back(desk, "Mirror", before, after)


def judge(desk: Desk, name: str, before: np.ndarray, after: np.ndarray, selected: np.ndarray) -> None:
    """What holds for every tool."""
    stage, changed = desk.stage, (after != before).any(axis=1)
    stage.numbers[f"{name} splats"] = int(changed.sum())
    stage.check(f"{name} changes splats", changed.any(), f"{changed.sum():,}")
    stage.check(f"{name}: the mode stays", desk.splats.mode == "EDIT", desk.splats.mode)
    stage.check(f"{name}: the selection stays", np.array_equal(desk.selected(), selected))
    stage.check(f"{name} keeps to the selection", not changed[~selected].any())
    column = desk.column(LOCKED)
    stage.check(f"{name}: the locked group stays", np.array_equal(after[:, column], before[:, column]))
    check_sums(desk, name, before, after)


def check_sums(desk: Desk, name: str, before: np.ndarray, after: np.ndarray) -> None:
    """Weights of changed splats sum to 1, of four bones at most."""
    changed = (after != before).any(axis=1)
    off = float(np.abs(after[changed].sum(axis=1) - 1).max(initial=0))
    most = int((after[changed] > 0).sum(axis=1).max(initial=0))
    desk.stage.check(f"{name}: sums stay 1, of four bones", off < 1e-3 and most <= 4, f"{off:.1e}, {most} bones")


def meant(
    desk: Desk, name: str, before: np.ndarray, after: np.ndarray, selected: np.ndarray, around: Around
) -> None:
    """What a tool is for."""
    stage, locked = desk.stage, desk.column(LOCKED)
    if name in ("Smooth", "Follow Neighbours"):
        measure = around.rough if name == "Smooth" else around.gap
        gaps = measure(before), measure(after)
        stage.check(f"{name}: more like those around", gaps[1] < gaps[0], f"{gaps[0]:.3f} apart, now {gaps[1]:.3f}")
    elif name == "Sharpen":
        changed = (after != before).any(axis=1)
        top = before[changed].max(axis=1).mean(), after[changed].max(axis=1).mean()
        stage.check("Sharpen: the strongest bone has more", top[1] > top[0], f"{top[0]:.3f}, now {top[1]:.3f}")
    else:
        whole = after[selected, desk.column(BONE)] + after[selected, locked]
        stage.check(f"{name} gives all that is not locked to the bone", np.abs(whole - 1).max() < 1e-3)


def there_and_back(desk: Desk, what: str, before: np.ndarray, after: np.ndarray) -> Story:
    """Control-Z takes it away, Control-Shift-Z brings it back, in the same mode."""
    mode = desk.splats.mode
    for word, keys, wanted in (("undo", "ctrl+z", before), ("redo", "ctrl+shift+z", after)):
        yield from desk.keys(keys)
        yield desk.stage.soon(lambda wanted=wanted: np.array_equal(desk.weights(), wanted), 8.0)
        good = np.array_equal(desk.weights(), wanted) and desk.splats.mode == mode
        desk.stage.check(f"{what}: {word}", good, desk.splats.mode)


class Around:
    """Selected splats, those not selected that each is nearest to, and the nearest of all."""

    def __init__(self, desk: Desk, selected: np.ndarray) -> None:
        points, others = desk.points(), np.flatnonzero(~selected)
        inside = np.flatnonzero(selected)
        self.inside = inside[:: max(1, len(inside) // SAMPLE)]
        self.outside = others[near(points[self.inside], points[others])]
        away = [np.linalg.norm(points - points[one], axis=1) for one in self.inside]
        self.beside = np.array([np.argpartition(one, 9)[:9] for one in away])

    def rough(self, weights: np.ndarray) -> float:
        """How far the weights are from the mean of those beside in the mean, 0 to 2."""
        return float(np.abs(weights[self.inside] - weights[self.beside].mean(axis=1)).sum(axis=1).mean())

    def gap(self, weights: np.ndarray) -> float:
        """How far apart the weights inside and outside are in the mean, 0 to 2."""
        return float(np.abs(weights[self.inside] - weights[self.outside]).sum(axis=1).mean())


def swapped(bone: str) -> str:
    """The bone of the other side."""
    return {"L": bone[:-1] + "R", "R": bone[:-1] + "L"}[bone[-1]] if bone[-2:] in (".L", ".R") else bone
