# SPDX-License-Identifier: GPL-3.0-or-later
"""Separate Selection by a click: the cape of the figure from the back that it lies on."""

from __future__ import annotations

import numpy as np
from arriving import choose
from stage import Story

from .desk import Desk

PART = ("cape.2", "cape.3")
"""Bones whose splats are separated."""


def separating(desk: Desk) -> Story:
    """By Bone selects; then the seam."""
    stage = desk.stage
    stage.chapter = "separate"
    choose(desk.view, desk.splats, desk.rig)
    desk.look((1.0, 0.6, 0.2))
    yield from desk.buttons.show("select")
    desk.choose(PART[0])
    yield from desk.buttons.press("gskin.select_by_bone", "By Bone of the cape")
    mask = desk.selected()
    stage.check("the cape is selected", mask.any(), f"{mask.sum():,}")
    yield from desk.hands.shoot("w50_cape")
    before = desk.weights()
    yield from desk.buttons.show("weights")
    if not (yield from desk.buttons.press("gskin.separate_parts", "Separate Selection")):
        return
    after = desk.weights()
    stage.check("Separate: the mode stays", desk.splats.mode == "EDIT", desk.splats.mode)
    stage.check("Separate: the selection stays", np.array_equal(desk.selected(), mask))
    yield from desk.tab("OBJECT")
    sides = desk.value("SIDE")
    stage.check("Separate leaves a seam", sides is not None)
    if sides is None:
        return
    inner, outer = np.unique(sides[mask]), np.setdiff1d(np.unique(sides[~mask]), [0])
    good = len(inner) == 1 and inner[0] != 0 and len(outer) >= 1 and inner[0] not in outer
    stage.check("the selection is one side of it, what it touches the other", good,
                f"{(sides == inner[0]).sum():,} against {np.isin(sides, outer).sum():,}")  # fmt: skip
    columns = [desk.column(name) for name in PART]
    body = np.isin(sides, outer)
    pulled = [int((one[body][:, columns].sum(axis=1) > 0.1).sum()) for one in (before, after)]
    seen = f"{pulled[0]:,}, now {pulled[1]:,}"
    stage.check("the back no longer follows the cape", pulled[1] <= 0.2 * pulled[0], seen)
    changed = (after != before).any(axis=1)
    off = float(np.abs(after[changed].sum(axis=1) - 1).max(initial=0))
    stage.check("Separate: sums stay 1", off < 1e-3, f"{off:.1e} of {changed.sum():,}")
    corners = np.empty(3 * len(desk.splats.data.polygons), np.int32)
    desk.splats.data.polygons.foreach_get("vertices", corners)
    labels = sides[corners.reshape(-1, 3)]
    joined = ((labels == inner[0]).any(axis=1) & np.isin(labels, outer).any(axis=1)).sum()
    seen = f"{joined} of {len(labels):,}"
    stage.check("no triangle of the fabric joins both sides", joined == 0 and len(labels), seen)
    yield from desk.settled()
    yield from desk.hands.shoot("w51_separated")
