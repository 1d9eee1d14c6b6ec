# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a skeleton of another program lies in splats: its axes, its unit and its place, guessed from its joints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.skeleton import Skeleton

Array = NDArray[Any]

_UNITS = (1.0, 0.01, 100.0, 0.0254, 0.001)
"""Factors between units that skeletons come in; the first is metres."""

_FITS = 0.035
"""A skeleton lies in the body where its misfit is below this share of the body's diagonal."""

_BETTER = 0.8
"""A guess must lower the misfit to this share of that of a simpler one."""

_CLEARER, _ALIKE = 0.95, 1.15
"""Turned about, a skeleton must lower the misfit to the first share to be taken so; up to the second times the misfit
the other way is as likely."""


_SLAB = 128
"""Points of bones whose distances are found at once."""


@dataclass(frozen=True)
class Placing:
    """x -> scale * rotation @ x + translation brings a skeleton into the splats; misfit: how badly it lies there, a
    share of the diagonal; plain: the words for what was done, empty for nothing; either_way: it lies there nearly as
    well when turned about, front to back."""

    rotation: Array
    scale: float
    translation: Array
    misfit: float
    plain: str
    either_way: bool = False

    @property
    def unsure(self) -> bool:
        """Whether the skeleton still seems to lie elsewhere."""
        return self.misfit > 2 * _FITS

    def of(self, skeleton: Skeleton) -> Skeleton:
        """The skeleton in the splats."""
        return skeleton.moved(self.rotation, self.scale, self.translation)


def guess_placing(skeleton: Skeleton, points: Array) -> Placing:
    """How to bring a skeleton into splats at points (N, 3) that stand with z up.

    As it is, where it lies in the body; else the simplest of: y up as in most other programs, another unit, another
    turn about the axes, another size and place, as a fit of boxes.
    """
    body = _Body.of(points)
    bones = _along(skeleton)
    best = Placing(np.eye(3), 1.0, np.zeros(3), body.misfit(bones), "")
    if best.misfit < _FITS:
        return best
    for words, options in (
        ("turned to z up", [(turn, 1.0, np.zeros(3)) for turn in _UP_TURNS]),
        ("unit changed", [(turn, unit, np.zeros(3)) for unit in _UNITS[1:] for turn in (np.eye(3), *_UP_TURNS)]),
    ):
        found = _best(body, bones, options, words)
        if found.misfit < _BETTER * best.misfit:
            best = found
        if best.misfit < _FITS:
            return best
    for turns in ((np.eye(3), *_UP_TURNS), _ALL_TURNS):
        found = _into_body(body, bones, turns)
        if found.misfit < _BETTER * best.misfit:
            best = found
        if best.misfit < _FITS:
            break
    return best


@dataclass(frozen=True)
class _Body:
    points: Array
    low: Array
    high: Array
    diagonal: float

    @classmethod
    def of(cls, points: Array) -> _Body:
        points = np.asarray(points, np.float64)
        low, high = np.percentile(points, [0.5, 99.5], axis=0)
        inside = points[((points >= low) & (points <= high)).all(axis=1)]
        kept = inside if len(inside) > 10 else points
        return cls(kept[:: max(1, len(kept) // 1500)], low, high, float(np.linalg.norm(high - low)) or 1.0)

    def misfit(self, bones: Array) -> float:
        """How far bones and body are from one another, both ways, a share of the diagonal."""
        # One table of all distances, in slabs: for so few points quicker than any search for the nearest.
        middle = (self.low + self.high) / 2  # squares of large numbers would leave nothing of small distances
        points, bones = self.points - middle, bones - middle
        there, back = np.empty(len(bones)), np.full(len(points), np.inf)
        own = np.square(points).sum(axis=1)
        for first in range(0, len(bones), _SLAB):
            slab = bones[first : first + _SLAB]
            square = slab @ (-2 * points.T)
            square += own
            square += np.square(slab).sum(axis=1)[:, None]
            there[first : first + _SLAB] = square.min(axis=1)
            np.minimum(back, square.min(axis=0), out=back)
        means = [np.maximum(found, 0).mean() for found in (there, back)]
        return float(np.sqrt(means).sum()) / self.diagonal / 2


def _along(skeleton: Skeleton) -> Array:
    """Points (n, 3) on the ways between joints and their parents; single joints where there are no ways."""
    parents = skeleton.parents
    child = np.flatnonzero(parents >= 0)
    share = np.linspace(0, 1, 6)[:, None, None]
    ways = skeleton.heads[parents[child]] + share * (skeleton.heads[child] - skeleton.heads[parents[child]])
    return np.concatenate([ways.reshape(-1, 3), skeleton.heads])


def _best(body: _Body, bones: Array, options: list[tuple[Array, float, Array]], words: str) -> Placing:
    found = []
    for turn, scale, shift in options:
        found.append(Placing(turn, scale, shift, body.misfit(scale * bones @ turn.T + shift), words))
    return min(found, key=lambda placing: placing.misfit)


def _into_body(body: _Body, bones: Array, turns: tuple[Array, ...]) -> Placing:
    """The best of these turns, scaled and moved into the splats.

    Boxes hardly tell front from back. So the turn about the vertical is tried to the end, too, and taken where it lies
    clearly better.
    """
    words = "turned and scaled into the splats"
    boxes = [(turn, *_into_box(bones @ turn.T, body)) for turn in turns]
    found = _refined(body, bones, _best(body, bones, boxes, words))
    about = _ABOUT @ found.rotation
    other = _refined(body, bones, _best(body, bones, [(about, *_into_box(bones @ about.T, body))], words))
    if other.misfit < _CLEARER * found.misfit:
        found, other = other, found
    return replace(found, either_way=other.misfit < _ALIKE * found.misfit)


def _into_box(bones: Array, body: _Body) -> tuple[float, Array]:
    """Scale and translation that put the box of the bones into that of the body, somewhat smaller: limbs go on."""
    low, high = bones.min(axis=0), bones.max(axis=0)
    size, own = body.high - body.low, high - low
    scale = float(np.median(0.93 * size / np.maximum(own, 1e-3 * max(float(own.max()), 1e-12))))
    largest = int(size.argmax())
    scale = min(scale, float(size[largest] / max(float(own[largest]), 1e-12)))
    return scale, (body.low + body.high) / 2 - scale * (low + high) / 2


def _refined(body: _Body, bones: Array, start: Placing) -> Placing:
    """Scale and translation by search around a start, in ever smaller steps."""
    best, step = start, 0.06
    centre = (body.low + body.high) / 2
    for _ in range(4):
        moved = True
        while moved:
            moved = False
            for factor, *way in ((1 + step, 0, 0, 0), (1 - step, 0, 0, 0), *((1, *np.eye(3)[a] * s) for a in range(3)
                                 for s in (-1, 1))):  # fmt: skip
                scale = best.scale * factor
                shift = centre + factor * (best.translation - centre) + step * body.diagonal * 0.5 * np.array(way)
                misfit = body.misfit(scale * bones @ best.rotation.T + shift)
                if misfit < best.misfit - 1e-6:
                    best, moved = Placing(best.rotation, scale, shift, misfit, best.plain), True
        step /= 2
    return best


def _turn(*rows: tuple[int, int, int]) -> Array:
    return np.array(rows, np.float64)


_UP_TURNS = (
    _turn((1, 0, 0), (0, 0, -1), (0, 1, 0)),  # y up, looking along z: glTF, BVH, Maya
    _turn((-1, 0, 0), (0, 0, 1), (0, 1, 0)),  # y up, looking along -z
    _turn((1, 0, 0), (0, 0, 1), (0, -1, 0)),  # -y up, as cameras have it
    _turn((-1, 0, 0), (0, -1, 0), (0, 0, 1)),  # z up, looking along y
    _turn((0, 1, 0), (-1, 0, 0), (0, 0, 1)),  # z up, looking along x
    _turn((0, -1, 0), (1, 0, 0), (0, 0, 1)),  # z up, looking along -x
)

_ABOUT = _turn((-1, 0, 0), (0, -1, 0), (0, 0, 1))

_ALL_TURNS = tuple(
    turn
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(turn := np.eye(3)[list(order)] * np.array(signs)[:, None]) > 0
)
"""All 24 turns that take axes to axes."""
