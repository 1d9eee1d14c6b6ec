# SPDX-License-Identifier: GPL-3.0-or-later
"""The selections of the panel Select, each by a click on its button, held to what a person expects of it."""

from __future__ import annotations

import bmesh
import numpy as np
from addon import part
from arriving import choose
from stage import Story

from .desk import Desk

BONE = "head"
ALIKE, FAR = 0.02, 0.3
"""sRGB distance within which two colours are the same to anybody, and beyond which they are not."""


def selecting(desk: Desk) -> Story:
    """From Object Mode on."""
    desk.stage.chapter = "select"
    choose(desk.view, desk.splats, desk.rig)
    desk.look()
    yield from desk.buttons.show("select")
    yield from by_bone(desk)
    yield from along_the_body(desk)
    yield from front_side(desk)
    yield from by_color(desk)
    yield from least_sure(desk)
    yield from desk.tab("OBJECT")


def by_bone(desk: Desk) -> Story:
    """A click in Object Mode goes to Edit Mode."""
    stage = desk.stage
    desk.choose(BONE)
    wanted = desk.weights()[:, desk.column(BONE)] >= 0.5
    yield from desk.buttons.press("gskin.select_by_bone", "By Bone")
    stage.check("By Bone goes to Edit Mode", desk.splats.mode == "EDIT", desk.splats.mode)
    wrong = int((desk.selected() != wanted).sum())
    stage.check("By Bone selects what the bone moves", wrong <= 0.002 * wanted.sum(),
                f"{desk.selected().sum():,} splats, {wrong} others than by their groups")  # fmt: skip
    yield from desk.hands.shoot("w31_by_bone")


def along_the_body(desk: Desk) -> Story:
    """Grow, Shrink, Linked."""
    stage, first = desk.stage, desk.selected()
    yield from desk.buttons.press("gskin.grow_splat_selection", "Grow")
    grown = desk.selected()
    good = grown.sum() > first.sum() and grown[first].all()
    stage.check("Grow adds splats and takes none", good, counts(first, grown))
    points = desk.points()
    rim = np.flatnonzero(grown & ~first)[::20]
    away = np.array([np.linalg.norm(points[first] - points[one], axis=1).min() for one in rim])
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    far = float(away.max(initial=0))
    stage.check("they lie around the selection", far < 0.05 * size, f"{far:.3f} m away")
    yield from desk.hands.shoot("w32_grown")
    yield from desk.buttons.press("gskin.shrink_splat_selection", "Shrink")
    shrunk = desk.selected()
    good = shrunk.sum() < grown.sum() and not shrunk[~grown].any()
    stage.check("Shrink takes splats and adds none", good, counts(grown, shrunk))
    same = (shrunk & first).sum() / (shrunk | first).sum()
    stage.check("Grow and Shrink are nearly where it began", same > 0.85, f"{same:.0%} in common")
    yield from desk.buttons.press("gskin.select_linked_splats", "Linked")
    linked = desk.selected()
    good = linked[shrunk].all() and linked.mean() > 0.9
    stage.check("Linked selects the whole figure", good, counts(shrunk, linked))


def front_side(desk: Desk) -> Story:
    """A box drawn through the figure becomes one of its front side."""
    stage, rig = desk.stage, desk.rig
    chest = rig.matrix_world @ rig.pose.bones["chest"].center
    yield from desk.box(chest, 60, 60)
    before = desk.selected()
    yield from desk.hands.shoot("w33_box")
    yield from desk.buttons.press("gskin.select_in_front", "Front Side Only")
    after = desk.selected()
    good = 0 < after.sum() < before.sum() and not after[~before].any()
    stage.check("Front Side Only keeps a part", good, counts(before, after))
    away = desk.points()[:, 1]  # seen along y
    kept, left = away[after], away[before & ~after]
    if len(kept) and len(left):
        good = np.quantile(kept, 0.9) < np.quantile(left, 0.5)
        seen = f"{kept.mean():.2f} m against {left.mean():.2f} m"
        stage.check("what it keeps lies before what it leaves", good, seen)
    yield from desk.hands.shoot("w34_front")


def by_color(desk: Desk) -> Story:
    """A splat is clicked, then what looks like it is selected."""
    stage = desk.stage
    head = desk.rig.matrix_world @ desk.rig.pose.bones[BONE].center
    yield from desk.hands.click(*desk.place(head))
    yield stage.pause(1.0)
    clicked = bmesh.from_edit_mesh(desk.splats.data).select_history.active
    stage.check("a click in Edit Mode selects a splat", isinstance(clicked, bmesh.types.BMVert), clicked)
    if not isinstance(clicked, bmesh.types.BMVert):
        return
    number = clicked.index
    yield from desk.buttons.press("gskin.select_by_color", "By Color")
    selected = desk.selected()
    yield from desk.hands.shoot("w35_by_color")
    yield from desk.tab("OBJECT")
    colors = part("scene.selecting").base_colors(desk.splats)
    yield from desk.tab("EDIT")
    off = np.linalg.norm(colors - colors[number], axis=1)
    good = selected[off < ALIKE].all() and 1 < selected.sum() < 0.9 * len(selected)
    stage.check("By Color selects all of the clicked colour", good, f"{selected.sum():,} like splat {number}")
    stage.check("and none of another", off[selected].max() < FAR, f"{off[selected].max():.2f} away in sRGB at most")


def least_sure(desk: Desk) -> Story:
    """Least Sure, then the clusters one after the other, each framed."""
    stage = desk.stage
    yield from desk.tab("OBJECT")
    sure = desk.value("CONFIDENCE")
    stage.check("the weights know how sure they are", sure is not None)
    if sure is None:
        return
    yield from desk.buttons.press("gskin.select_unsure_splats", "Least Sure")
    selected = desk.selected()
    good = abs(selected.mean() - 0.05) < 1e-3 and sure[selected].max() <= sure[~selected].min() + 1e-6
    seen = f"{selected.sum():,} up to {sure[selected].max():.0%}"
    stage.check("Least Sure selects the twentieth that is", good, seen)
    clusters, framed = [], []
    for click in (1, 2):
        yield from desk.buttons.press("gskin.next_unsure_cluster", f"Worst Cluster, click {click}")
        now = desk.selected()
        camera = desk.view.space.region_3d
        clusters.append(now)
        middle = desk.points()[now].mean(axis=0) if now.any() else np.zeros(3)
        framed.append(float(np.linalg.norm(np.array(camera.view_location) - middle)))
        stage.check(f"click {click} selects unsure splats", now.any() and not now[~selected].any(), f"{now.sum():,}")
        yield stage.pause(0.6)
        yield from desk.hands.shoot(f"w3{click + 5}_cluster")
    doubt = [float((1 - sure[mask]).sum()) for mask in clusters]
    stage.check("the clusters are two", not (clusters[0] & clusters[1]).any())
    stage.check("the one with the most doubt comes first", doubt[0] >= doubt[1], f"{doubt[0]:.1f}, {doubt[1]:.1f}")
    size = float(np.linalg.norm(np.ptp(desk.points(), axis=0)))
    stage.check("the view shows them", max(framed) < 0.1 * size, f"{max(framed):.2f} m off")


def counts(before: np.ndarray, after: np.ndarray) -> str:
    """For people."""
    return f"{before.sum():,} to {after.sum():,}"
