# SPDX-License-Identifier: GPL-3.0-or-later
"""A shape brought onto another one that lies nearly in the same place, by small turns, moves and one scale.

Iterated closest points with point-to-plane distances (Chen & Medioni 1992), the furthest left out (trimmed ICP,
Chetverikov et al. 2002).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.nearest_points import nearest_points
from ...ticks import Tick, silent
from .match import agree

Array = NDArray[Any]

_SAMPLES, _TURNS = 3000, 25
_KEPT = 0.8
"""Share of the matches that count: the nearest. The rest may be what only one of the shapes has."""
_ANGLE = 60.0
_DAMPING = 1e-3
"""Of the normal equations: what the shape does not tell, as a tube its spin, stays."""
_SCALE, _SPIN = 1.25, np.radians(30)
"""More than this between shapes that lie nearly in the same place is a fit gone astray."""


def align(
    points: Array, facing: Array, onto: Array, onto_facing: Array, reach: float, tick: Tick = silent
) -> Array:
    """The matrix (4, 4) of a similarity that brings points (N, 3) onto those of another shape (M, 3).

    facing (N, 3) and onto_facing (M, 3): see `facing`; only points that face one another's way are matched, up to
    `reach`, in metres. The identity where nothing matches or the fit runs off.
    """
    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(onto))[:_SAMPLES]
    goal, goal_facing = np.asarray(onto, np.float64)[chosen], onto_facing[chosen]
    length = np.linalg.norm(goal_facing, axis=1, keepdims=True)
    normal = goal_facing / np.where(length > 0, length, 1)
    centre = np.asarray(points, np.float64).mean(axis=0)
    size = float(np.linalg.norm(np.ptp(points, axis=0))) or 1.0
    # In units of the shape, about its middle: turns, moves and the scale weigh alike.
    start, goal = (np.asarray(points, np.float64) - centre) / size, (goal - centre) / size
    matrix = np.eye(4)
    first = np.inf
    for turn in range(_TURNS):
        tick(turn / _TURNS)
        moved = start @ matrix[:3, :3].T + matrix[:3, 3]
        way, index = nearest_points(moved, goal, 1)
        way, near = way[:, 0], moved[index[:, 0]]
        good = (way <= reach / size) & agree(goal_facing, facing[index[:, 0]], _ANGLE) & (length[:, 0] > 0)
        if good.sum() < 10:
            return np.eye(4)
        good &= way <= np.quantile(way[good], _KEPT)
        first = float(way[good].mean()) if turn == 0 else first
        step = _step(near[good], goal[good], normal[good])
        matrix = step @ matrix
        if np.abs(step - np.eye(4)).max() < 1e-6:
            break
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    spin = np.arccos(np.clip((np.trace(matrix[:3, :3]) / scale - 1) / 2, -1, 1))
    if not 1 / _SCALE < scale < _SCALE or spin > _SPIN or float(way[good].mean()) > first:
        return np.eye(4)
    out = np.eye(4)
    out[:3, :3] = matrix[:3, :3]
    out[:3, 3] = centre + size * matrix[:3, 3] - matrix[:3, :3] @ centre
    return out


def _step(near: Array, goal: Array, normal: Array) -> Array:
    """The matrix (4, 4) that brings near (K, 3) closest to the planes through goal (K, 3) with normals (K, 3)."""
    rows = np.concatenate([np.cross(near, normal), normal, (near * normal).sum(axis=1, keepdims=True)], axis=1)
    gap = ((goal - near) * normal).sum(axis=1)
    square = rows.T @ rows
    square += _DAMPING * np.trace(square) / 7 * np.eye(7)
    spin, move, grow = np.split(np.linalg.solve(square, rows.T @ gap), [3, 6])
    angle = float(np.linalg.norm(spin))
    cross = np.array([[0, -spin[2], spin[1]], [spin[2], 0, -spin[0]], [-spin[1], spin[0], 0]])
    a, b = (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2) if angle > 1e-9 else (1.0, 0.5)
    out = np.eye(4)
    out[:3, :3] = (1 + grow[0]) * (np.eye(3) + a * cross + b * cross @ cross)
    out[:3, 3] = move
    return out
