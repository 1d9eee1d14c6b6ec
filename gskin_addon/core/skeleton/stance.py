# SPDX-License-Identifier: GPL-3.0-or-later
"""How a body stands: where its floor and its middle are, its unit of length, and how it may be turned."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .body_shape import BodyShape

Array = NDArray[Any]

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""A quarter turn about z, from x to y."""

_ANGLES = np.radians(np.arange(0, 180, 3))
_STRAIGHT = 0.03
"""So much better must the body mirror in a slanted plane than in a straight one, for it to count as turned."""


@dataclass(frozen=True)
class Standing:
    """shape: the body moved so that its floor is z = 0 and its middle x = y = 0; origin (3,): where that was; scale:
    its unit of length, diagonal: that of its box, both metres."""

    shape: BodyShape
    origin: Array
    scale: float
    diagonal: float


def stand(shape: BodyShape, unit: str) -> Standing:
    """A body in its own frame. unit: "height", or "diagonal" of the box."""
    size = shape.high - shape.low
    origin = np.array([*(shape.low + shape.high)[:2] / 2, shape.low[2]])
    diagonal = float(np.linalg.norm(size))
    moved = replace(
        shape, points=shape.points - origin, end=shape.end - origin, low=shape.low - origin, high=shape.high - origin
    )
    return Standing(moved, origin, float(size[2]) if unit == "height" else diagonal, diagonal)


def quarter_turns(shape: BodyShape) -> list[BodyShape]:
    """A body as it is, and turned about z by one, two and three quarters."""
    turns = [shape]
    while len(turns) < 4:
        turns.append(turns[-1].turned(QUARTER, np.zeros(3)))
    return turns


def feet_ahead(standing: Standing) -> float:
    """How much farther the feet of a person reach before the shins than behind them, in heights; 0 where none are."""
    points, height = standing.shape.points, standing.scale
    beside = np.abs(points[:, 0]) < 0.25 * height
    low = beside & (points[:, 2] < 0.05 * height)
    shin = beside & (points[:, 2] > 0.1 * height) & (points[:, 2] < 0.2 * height)
    found = []
    for side in (points[:, 0] > 0, points[:, 0] < 0):
        foot, leg = points[low & side, 1], points[shin & side, 1]
        if len(foot) > 3 and len(leg) > 3:
            middle = float(np.median(leg))
            found.append(((middle - foot.min()) - (foot.max() - middle)) / height)
    return float(np.mean(found)) if found else 0.0


def slant(points: Array) -> float:
    """How far, in radians within an eighth of a turn, a body at points (M, 3) must be turned about z to stand
    straight: its plane of symmetry across x or y. 0 where nothing tells."""
    centre = np.array([*points[:, :2].mean(axis=0), 0.0])
    own = points - centre
    cell = float(np.ptp(own, axis=0).max()) / 24 or 1.0
    reach = np.ceil(np.abs(own).max() / cell).astype(int) + 2
    grid = np.zeros((2 * reach + 1,) * 3, bool)
    grid[tuple((np.rint(own / cell).astype(int) + reach).T)] = True
    found = []
    for angle in _ANGLES:
        across = np.array([np.cos(angle), np.sin(angle), 0.0])
        other = own - 2 * (own @ across)[:, None] * across
        found.append(float(grid[tuple((np.rint(other / cell).astype(int) + reach).T)].mean()))
    score = np.array(found)
    straight = max(score[0], score[len(score) // 2])
    best = int(score.argmax())
    if score[best] <= straight + _STRAIGHT:
        return 0.0
    angle = float(_ANGLES[best])
    return -((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)
