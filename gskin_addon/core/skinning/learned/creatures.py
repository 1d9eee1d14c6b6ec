# SPDX-License-Identifier: GPL-3.0-or-later
"""Bodies that the project makes up: skeletons grown at random, flesh around them, weights by rule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...rig.skeleton import Skeleton
from ...splats.cloud import SH_C0, SplatCloud

if TYPE_CHECKING:
    from .examples import Subject

Array = NDArray[Any]
MIRROR = np.array([-1.0, 1.0, 1.0])


@dataclass
class _Flesh:
    """A capsule that tapers from radius r0 to r1, flattened along `flat`; it moves with `bone`."""

    start: Array
    end: Array
    r0: float
    r1: float
    flat: Array
    thin: float
    bone: int
    color: Array
    rigid: bool

    def local(self, points: Array) -> tuple[Array, Array]:
        """Place along the axis, 0 to 1, and signed distance to the surface, roughly."""
        axis = self.end - self.start
        away = points - self.start
        away = away + (1 / self.thin - 1) * (away @ self.flat)[:, None] * self.flat
        t = (away @ axis / max(axis @ axis, 1e-12)).clip(0, 1)
        radius = self.r0 + (self.r1 - self.r0) * t
        return t, np.linalg.norm(away - t[:, None] * axis, axis=1) - radius

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Points on the surface, about evenly."""
        axis = self.end - self.start
        length = max(float(np.linalg.norm(axis)), 1e-9)
        axis = axis / length
        side = np.cross(axis, [0.3, 0.5, 0.81])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        along = rng.uniform(-self.r0, length + self.r1, count)
        t = along.clip(0, length)
        radius = self.r0 + (self.r1 - self.r0) * t / length
        around = np.sqrt(np.maximum(radius**2 - (along - t) ** 2, 0))
        angle = rng.uniform(0, 2 * np.pi, count)
        ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
        points = along[:, None] * axis + around[:, None] * ring
        return self.start + points + (self.thin - 1) * (points @ self.flat)[:, None] * self.flat

    @property
    def area(self) -> float:
        return float((self.r0 + self.r1) * (np.linalg.norm(self.end - self.start) + self.r0 + self.r1))


@dataclass
class _Plan:
    """A creature while it grows."""

    rng: np.random.Generator
    parents: list[int] = field(default_factory=list)
    heads: list[Array] = field(default_factory=list)
    tails: list[Array] = field(default_factory=list)
    flesh: list[_Flesh] = field(default_factory=list)

    def bone(self, parent: int, head: Array, tail: Array) -> int:
        self.parents.append(parent)
        self.heads.append(np.asarray(head, float))
        self.tails.append(np.asarray(tail, float))
        return len(self.parents) - 1

    def cover(
        self, bone: int, r0: float, r1: float, color: Array, *, flat: Array | None = None, thin: float = 1.0,
        segment: tuple[Array, Array] | None = None, rigid: bool = False,
    ) -> None:  # fmt: skip
        start, end = segment or (self.heads[bone], self.tails[bone])
        axis = np.array([1.0, 0, 0]) if flat is None else flat / np.linalg.norm(flat)
        self.flesh.append(_Flesh(start, end, r0, r1, axis, thin, bone, color, rigid))

    def chain(
        self, parent: int, start: Array, direction: Array, lengths: Array, radius: float, taper: float, color: Array,
        *, bend: float = 0.3, flat: Array | None = None, thin: float = 1.0,
    ) -> list[int]:  # fmt: skip
        """Bones in a row, each turned a little against the last; returns them."""
        made: list[int] = []
        at, way = np.asarray(start, float), np.asarray(direction, float)
        for length in lengths:
            way = way / np.linalg.norm(way)
            parent = self.bone(parent, at, at + way * length)
            self.cover(parent, radius, radius * taper, color, flat=flat, thin=thin)
            made.append(parent)
            at, radius = at + way * length, radius * taper
            way = way + self.rng.normal(0, bend, 3)
        return made

    def mirror(self, bones: int, flesh: int) -> None:
        """The same again on the other side: everything from bone number `bones` and flesh number `flesh` on."""
        count = len(self.parents) - bones
        for bone in range(bones, bones + count):
            parent = self.parents[bone] + (count if self.parents[bone] >= bones else 0)
            self.bone(parent, self.heads[bone] * MIRROR, self.tails[bone] * MIRROR)
        for part in self.flesh[flesh:]:
            bone = part.bone + count if part.bone >= bones else part.bone
            mirrored = {"start": part.start * MIRROR, "end": part.end * MIRROR, "flat": part.flat * MIRROR}
            self.flesh.append(replace(part, bone=bone, **mirrored))

    def limbs(self, grow: Callable[[], None]) -> None:
        """What `grow` makes at x > 0, on both sides."""
        bones, flesh = len(self.parents), len(self.flesh)
        grow()
        self.mirror(bones, flesh)


def generate(rng: np.random.Generator) -> Subject:
    """A random creature, about 2 units large, with 4000 to 6000 splats and weights that follow a rule."""
    from .examples import Subject

    plan = _Plan(rng)
    [_biped, _quadruped, _crawler, _swimmer, _biped, _quadruped][rng.integers(6)](plan)
    names = tuple(f"{i}" for i in range(len(plan.parents)))
    skeleton = Skeleton(names, np.array(plan.parents), np.array(plan.heads), np.array(plan.tails))
    points, colors, weights = _skin(plan, skeleton, int(rng.integers(4000, 6000)))
    count = len(points)
    spacing = float(np.sqrt(sum(part.area for part in plan.flesh) * 3 / count))
    cloud = SplatCloud(
        points.astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full((count, 3), 0.5 * spacing, np.float32),
        rng.uniform(0.8, 0.99, count).astype(np.float32),
        ((colors - 0.5) / SH_C0)[:, None].astype(np.float32),
    )
    return Subject(cloud, skeleton, weights.astype(np.float32), np.ones(count, bool))


def _color(rng: np.random.Generator) -> Array:
    return rng.uniform(0.05, 0.95, 3)


def _head(plan: _Plan, parent: int, at: Array, way: Array, size: float, color: Array) -> int:
    """A head, perhaps with a jaw, ears or horns, eyes and a hat."""
    rng = plan.rng
    head = plan.bone(parent, at, at + way * 2 * size)
    skin = color if rng.random() < 0.5 else _color(rng)
    plan.cover(head, size * rng.uniform(0.8, 1.2), size * rng.uniform(0.6, 1.2), skin)
    middle = at + way * size
    front = np.array([0.0, -1.0, 0.0])
    if rng.random() < 0.3:
        jaw = plan.bone(head, at + 0.3 * size * way, at + 1.4 * size * front)
        plan.cover(jaw, 0.4 * size, 0.3 * size, skin)
    if rng.random() < 0.5:  # ears with bones, or horns without
        boned, hue = rng.random() < 0.6, _color(rng) if rng.random() < 0.5 else skin
        side = np.array([0.6, 0.1, 0.6]) * size

        def ear() -> None:
            start, length = middle + side + way * 0.3 * size, rng.uniform(0.5, 1.6) * size
            if boned:
                plan.chain(head, start, side, np.full(rng.integers(1, 3), length), 0.25 * size, 0.6, hue)
            else:
                tip = start + side / size * length
                plan.cover(head, 0.2 * size, 0.05 * size, hue, segment=(start, tip), rigid=True)

        plan.limbs(ear)
    if rng.random() < 0.5:
        eye, hue = middle + size * np.array([0.4, -0.95, 0.1]), _color(rng)
        plan.limbs(lambda: plan.cover(head, 0.15 * size, 0.15 * size, hue, segment=(eye, eye + 1e-3), rigid=True))
    if rng.random() < 0.4:
        top, hue = at + way * 2.0 * size, _color(rng)
        plan.cover(head, rng.uniform(0.6, 1.3) * size, rng.uniform(0.2, 0.8) * size, hue,
                   segment=(top, top + way * rng.uniform(0.3, 1.2) * size), rigid=True)  # fmt: skip
    return head


def _carried(plan: _Plan, bones: list[int], size: float) -> None:
    """Rigid things in hands, on backs or hovering near: they move with one bone as a whole."""
    rng = plan.rng
    for bone in bones:
        if rng.random() < 0.35:
            way = rng.normal(size=3)
            way /= np.linalg.norm(way)
            middle = plan.tails[bone] + way * size * rng.uniform(0, 0.8)
            reach = way * size * rng.uniform(0.3, 2.5)
            flat = np.cross(way, rng.normal(size=3))
            span = (middle - 0.3 * reach, middle + 0.7 * reach)
            plan.cover(bone, size * rng.uniform(0.15, 0.5), size * rng.uniform(0.1, 0.5), _color(rng), flat=flat,
                       thin=rng.uniform(0.25, 1), segment=span, rigid=True)  # fmt: skip


def _spine(plan: _Plan, start: Array, way: Array, length: float, radius: float, color: Array) -> list[int]:
    """A root, perhaps bare, and a row of bones with the trunk around them."""
    rng = plan.rng
    parent = -1
    if rng.random() < 0.3:
        parent = plan.bone(-1, np.zeros(3), np.array([0.0, 0.0, 0.2]))
    count = int(rng.integers(1, 5))
    wide = np.array([1.0, 0.0, 0.0])
    taper = rng.uniform(0.9, 1.1)
    return plan.chain(parent, start, way, np.full(count, length / count), radius, taper, color, bend=0.05,
                      flat=np.cross(way, wide), thin=rng.uniform(0.5, 1.0))  # fmt: skip


def _legs(plan: _Plan, parent: int, hip: Array, height: float, radius: float, color: Array, tips: list[int]) -> None:
    rng = plan.rng

    def leg() -> None:
        count = int(rng.integers(2, 5))
        share = rng.uniform(0.7, 1.3, count)
        way = np.array([rng.uniform(0, 0.3), rng.uniform(-0.2, 0.2), -1.0])
        made = plan.chain(parent, hip, way, height * share / share.sum(), radius, 0.8, color, bend=0.12)
        if rng.random() < 0.7:
            shoe = _color(rng) if rng.random() < 0.5 else color
            at = plan.tails[made[-1]]
            foot = plan.bone(made[-1], at, at + np.array([0.05, -1.0, -0.15]) * radius * 2.5)
            plan.cover(foot, radius * 0.8, radius * 0.6, shoe)
        tips.append(made[-1])

    plan.limbs(leg)


def _tail(plan: _Plan, parent: int, start: Array, way: Array, length: float, radius: float, color: Array) -> None:
    count = int(plan.rng.integers(1, 7))
    plan.chain(parent, start, way, np.full(count, length / count), radius, 0.8, color, bend=0.2)


def _wings(plan: _Plan, parent: int, start: Array, span: float, color: Array) -> None:
    rng = plan.rng

    def wing() -> None:
        count = int(rng.integers(1, 4))
        hue = _color(rng)
        plan.chain(parent, start, np.array([1.0, 0.3, 0.4]), np.full(count, span / count), span * 0.25, 0.8, hue,
                   bend=0.2, flat=np.array([0.0, 0.3, 1.0]), thin=0.15)  # fmt: skip

    plan.limbs(wing)


def _biped(plan: _Plan) -> None:
    rng, color = plan.rng, _color(plan.rng)
    trousers = _color(rng) if rng.random() < 0.7 else color
    tall, stout = rng.uniform(0.5, 0.9), rng.uniform(0.12, 0.3)
    hip = np.array([0.0, 0.0, rng.uniform(0.4, 0.9)])
    spine = _spine(plan, hip, np.array([0.0, 0.0, 1.0]), tall, stout, color)
    top = plan.tails[spine[-1]]
    tips: list[int] = []
    _legs(plan, spine[0], hip + [0.6 * stout, 0, 0], hip[2], stout * rng.uniform(0.35, 0.6), trousers, tips)
    size, neck = rng.uniform(0.12, 0.35), spine[-1]
    if rng.random() < 0.7:
        neck = plan.chain(neck, top, np.array([0.0, 0, 1.0]), np.array([0.12]), 0.4 * size, 1.0, color, bend=0)[0]
    head = _head(plan, neck, plan.tails[neck], np.array([0.0, 0, 1.0]), size, color)
    skin = _color(rng) if rng.random() < 0.5 else color

    def arm() -> None:
        parent, start = spine[-1], top + [0.9 * stout, 0, -0.3 * stout]
        if rng.random() < 0.6:
            parent = plan.bone(parent, top - [0, 0, 0.1], start)
        way = np.array([1.0, 0.0, rng.uniform(-1.5, 0.1)])
        reach, thick = rng.uniform(0.4, 0.9), stout * rng.uniform(0.25, 0.45)
        made = plan.chain(parent, start, way, np.array([0.5, 0.5]) * reach, thick, 0.85, skin, bend=0.15)
        hand = plan.chain(made[-1], plan.tails[made[-1]], way, np.array([0.2 * reach]), thick, 1.0, skin, bend=0.1)[0]
        for finger in range(int(rng.integers(0, 5)) if rng.random() < 0.4 else 0):
            spread = way + [0.0, 0.5 * (finger - 2), 0]
            at = plan.tails[hand]
            plan.chain(hand, at, spread, np.full(rng.integers(1, 4), 0.08 * reach), 0.3 * thick, 0.9, skin, bend=0.1)
        tips.append(hand)

    plan.limbs(arm)
    if rng.random() < 0.25:
        back, way = hip + [0, stout, 0], np.array([0.0, 1.0, -0.5])
        _tail(plan, spine[0], back, way, rng.uniform(0.3, 1.0), 0.4 * stout, color)
    if rng.random() < 0.2:
        _wings(plan, spine[-1], top + [0.3 * stout, stout, -0.1], rng.uniform(0.4, 1.0), color)
    _carried(plan, [tips[-1], head, spine[-1]], rng.uniform(0.15, 0.35))


def _quadruped(plan: _Plan) -> None:
    rng, color = plan.rng, _color(plan.rng)
    high, long, stout = rng.uniform(0.3, 0.9), rng.uniform(0.6, 1.4), rng.uniform(0.14, 0.3)
    back = np.array([0.0, long / 2, high])
    spine = _spine(plan, back, np.array([0.0, -1.0, rng.uniform(-0.1, 0.2)]), long, stout, color)
    front, tips = plan.tails[spine[-1]], list[int]()
    thick = stout * rng.uniform(0.3, 0.5)
    for parent, at in ((spine[0], back), (spine[-1], front)):
        _legs(plan, parent, at + [0.6 * stout, 0, -0.3 * stout], high, thick, color, tips)
    count, way = int(rng.integers(1, 4)), np.array([0.0, -1.0, rng.uniform(0, 1.5)])
    long_neck = np.full(count, rng.uniform(0.2, 0.7) / count)
    neck = plan.chain(spine[-1], front, way, long_neck, 0.6 * stout, 0.85, color, bend=0.1)
    _head(plan, neck[-1], plan.tails[neck[-1]], np.array([0.0, -0.9, -0.1]), stout * rng.uniform(0.5, 0.9), color)
    if rng.random() < 0.8:
        _tail(plan, spine[0], back, np.array([0.0, 1.0, -0.3]), rng.uniform(0.2, 1.0), 0.3 * stout, color)
    if rng.random() < 0.2:
        _wings(plan, spine[-1], front + [0.3 * stout, 0, 0.8 * stout], rng.uniform(0.5, 1.2), color)
    _carried(plan, [spine[0], spine[-1]], 0.25)


def _crawler(plan: _Plan) -> None:
    rng, color = plan.rng, _color(plan.rng)
    high, long, stout = rng.uniform(0.15, 0.5), rng.uniform(0.4, 1.2), rng.uniform(0.12, 0.3)
    back = np.array([0.0, long / 2, high])
    spine = _spine(plan, back, np.array([0.0, -1.0, 0.0]), long, stout, color)
    hue = _color(rng) if rng.random() < 0.5 else color
    pairs = int(rng.integers(2, 6))
    for number in range(pairs):
        share = (number + 0.5) / pairs
        at = back + [0.8 * stout, -long * share, 0]
        parent = spine[min(int(share * len(spine)), len(spine) - 1)]

        def leg(at: Array = at, parent: int = parent, lean: float = share - 0.5) -> None:
            thigh = np.full(1, rng.uniform(0.15, 0.4))
            made = plan.chain(parent, at, np.array([1.0, -lean, 0.6]), thigh, 0.06, 0.9, hue)
            way = np.array([0.7, -lean, -1.0])
            plan.chain(made[-1], plan.tails[made[-1]], way, np.full(rng.integers(1, 3), 0.3), 0.05, 0.7, hue, bend=0.1)

        plan.limbs(leg)
    _head(plan, spine[-1], plan.tails[spine[-1]], np.array([0.0, -1.0, 0.0]), 0.7 * stout, color)
    if rng.random() < 0.3:
        _tail(plan, spine[0], back, np.array([0.0, 1.0, 0.5]), rng.uniform(0.3, 1.0), 0.3 * stout, color)


def _swimmer(plan: _Plan) -> None:
    """Snakes and fish."""
    rng, color = plan.rng, _color(plan.rng)
    count, long, stout = int(rng.integers(3, 14)), rng.uniform(1.0, 2.0), rng.uniform(0.06, 0.25)
    parent = plan.bone(-1, np.zeros(3), np.array([0.0, 0.0, 0.2])) if rng.random() < 0.3 else -1
    made = plan.chain(parent, np.zeros(3), np.array([0.0, 1.0, 0.0]), np.full(count, long / count), stout, 0.9, color,
                      bend=rng.uniform(0, 0.2), flat=np.array([1.0, 0, 0]), thin=rng.uniform(0.5, 1))  # fmt: skip
    _head(plan, made[0], plan.heads[made[0]], np.array([0.0, -1.0, 0.0]), stout * rng.uniform(0.6, 1.1), color)
    if rng.random() < 0.6:
        at, hue = plan.heads[made[count // 3]], _color(rng)
        flat = np.array([0.0, 0.2, 1.0])

        def fin() -> None:
            start, reach = at + [0.4 * stout, 0, 0], np.array([2 * stout])
            way = np.array([1.0, 0.8, 0.0])
            bone = plan.chain(made[count // 3], start, way, reach, 0.5 * stout, 0.6, hue, flat=flat, thin=0.2)[0]
            plan.cover(bone, 0.4 * stout, 0.3 * stout, hue, flat=flat, thin=0.2)

        plan.limbs(fin)


def _skin(plan: _Plan, skeleton: Skeleton, count: int) -> tuple[Array, Array, Array]:
    """Points on the outside of all flesh, their colours and weights.

    Flesh blends between its bone and the bones next to it in the tree by how deep the point lies in the flesh of
    each; rigid parts follow their bone alone.
    """
    rng = plan.rng
    area = np.array([part.area for part in plan.flesh])
    soft = rng.uniform(0.08, 0.5)
    points, colors, weights = [], [], []
    by_bone: dict[int, list[_Flesh]] = {}
    for part in plan.flesh:
        if not part.rigid:
            by_bone.setdefault(part.bone, []).append(part)
    for number, part in enumerate(plan.flesh):
        some = part.sample(max(int(1.5 * count * area[number] / area.sum()), 8), rng)
        buried = np.zeros(len(some), bool)
        for other in plan.flesh:
            if other is not part:
                buried |= other.local(some)[1] < -0.1 * min(other.r0, other.r1) * other.thin
        some = some[~buried]
        own = np.zeros((len(some), skeleton.count))
        if part.rigid:
            own[:, part.bone] = 1
        else:
            kin = [part.bone, int(skeleton.parents[part.bone]), *skeleton.children(part.bone)]
            for bone in kin:
                for flesh in by_bone.get(int(bone), []):
                    depth = flesh.local(some)[1] / (soft * (part.r0 + part.r1))
                    own[:, bone] = np.maximum(own[:, bone], np.exp(-depth.clip(-20, 20) * 2))
        points.append(some)
        colors.append(np.tile(part.color, (len(some), 1)))
        weights.append(own / np.maximum(own.sum(axis=1, keepdims=True), 1e-30))
    every = np.concatenate(points), np.concatenate(colors), np.concatenate(weights)
    picked = rng.permutation(len(every[0]))[:count]
    return every[0][picked], every[1][picked], every[2][picked]
