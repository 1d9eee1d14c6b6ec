# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthetic creatures: random skeletons, capsules around them, and weights by rule."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...rig.segments import closest_on_segment
from ...rig.skeleton import Skeleton
from ...splats.cloud import SH_C0, SplatCloud
from . import clothes, synthetic_objects
from .capsules import RigBuilder, cover_with_splats
from .synthetic_objects import random_color

if TYPE_CHECKING:
    from .examples import TrainingBody

Array = NDArray[Any]
BURIED_ROOTS = 0.5
"""Share of the creatures in which some bones start inside the capsules of others."""

LEG = ("UpperLeg", "LowerLeg", "Foot")
ARM = ("UpperArm", "LowerArm")


def generate_creature(rng: np.random.Generator, grow: Callable[[RigBuilder], None] | None = None) -> TrainingBody:
    """A random creature, about 2 units large, with up to 6000 splats and weights that follow a rule.

    grow: one of `KINDS`, by default a random one.
    """
    from .examples import TrainingBody

    rig = RigBuilder(rng)
    kinds, often = zip(*KINDS, strict=True)
    (grow or kinds[rng.choice(len(kinds), p=np.array(often) / sum(often))])(rig)
    names = tuple(f"{name}.{i}" for i, name in enumerate(rig.names))
    skeleton = Skeleton(names, np.array(rig.parents), np.array(rig.heads), np.array(rig.tails))
    points, colors, weights = cover_with_splats(rig, skeleton, int(rng.integers(4000, 6000)))
    skeleton = bury_limb_roots(skeleton, rig, rng)
    count = len(points)
    spacing = float(np.sqrt(sum(part.area for part in rig.capsules) * 3 / count))
    cloud = SplatCloud(
        points.astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full((count, 3), 0.5 * spacing, np.float32),
        rng.uniform(0.8, 0.99, count).astype(np.float32),
        ((colors - 0.5) / SH_C0)[:, None].astype(np.float32),
    )
    return TrainingBody(cloud, skeleton, weights.astype(np.float32), np.ones(count, bool))


def bury_limb_roots(skeleton: Skeleton, rig: RigBuilder, rng: np.random.Generator) -> Skeleton:
    """Move the heads of limbs, wings and ears of half of the creatures into the body, up to its axis, as many artists
    place them: what surrounds the first part of such a bone belongs to the body."""
    deep = rng.uniform(0.2, 1.0)
    if rng.random() > BURIED_ROOTS:
        return skeleton
    radius = np.zeros(skeleton.count)
    for part in rig.capsules:
        radius[part.bone] = max(radius[part.bone], part.r0)
    heads = skeleton.heads.copy()
    for bone, parent in enumerate(skeleton.parents):
        if parent >= 0 and 0 < radius[bone] < 0.7 * radius[parent]:
            own = skeleton.heads[bone : bone + 1]
            axis = closest_on_segment(own, skeleton.heads[parent], skeleton.tails[parent])
            heads[bone] += deep * (axis - own)[0]
    return Skeleton(skeleton.names, skeleton.parents, heads, skeleton.tails)


def _add_head(rig: RigBuilder, parent: int, at: Array, way: Array, size: float, color: Array) -> int:
    """A head, perhaps with a jaw, ears or horns, eyes and a hat."""
    rng = rig.rng
    head = rig.add_bone(parent, at, at + way * 2 * size, "Head")
    skin = color if rng.random() < 0.5 else random_color(rng)
    rig.add_capsule(head, size * rng.uniform(0.8, 1.2), size * rng.uniform(0.6, 1.2), skin)
    middle = at + way * size
    front = np.array([0.0, -1.0, 0.0])
    if rng.random() < 0.3:
        jaw = rig.add_bone(head, at + 0.3 * size * way, at + 1.4 * size * front, "Jaw")
        rig.add_capsule(jaw, 0.4 * size, 0.3 * size, skin)
    if rng.random() < 0.5:  # ears with bones, or horns without
        boned, hue = rng.random() < 0.6, random_color(rng) if rng.random() < 0.5 else skin
        side = np.array([0.6, 0.1, 0.6]) * size

        def ear() -> None:
            start, length = middle + side + way * 0.3 * size, rng.uniform(0.5, 1.6) * size
            if boned:
                rig.add_chain(head, start, side, np.full(rng.integers(1, 3), length), 0.25 * size, 0.6, hue,
                              names=("Ear",))  # fmt: skip
            else:
                tip = start + side / size * length
                rig.add_capsule(head, 0.2 * size, 0.05 * size, hue, segment=(start, tip), rigid=True)

        rig.add_mirrored(ear)
    if rng.random() < 0.5:
        eye, hue = middle + size * np.array([0.4, -0.95, 0.1]), random_color(rng)
        span, radius = (eye, eye + 1e-3), 0.15 * size
        rig.add_mirrored(lambda: rig.add_capsule(head, radius, radius, hue, segment=span, rigid=True))
    if rng.random() < 0.4:
        top, hue = at + way * 2.0 * size, random_color(rng)
        rig.add_capsule(head, rng.uniform(0.6, 1.3) * size, rng.uniform(0.2, 0.8) * size, hue,
                        segment=(top, top + way * rng.uniform(0.3, 1.2) * size), rigid=True)  # fmt: skip
    if rng.random() < 0.3:
        clothes.add_hair(rig, head, middle + np.array([0.0, 0.7 * size, 0.4 * size]), size)
    return head


def _add_held_objects(rig: RigBuilder, bones: list[int], size: float) -> None:
    """Rigid objects in hands, on backs or hovering nearby: each follows one bone alone."""
    rng = rig.rng
    for bone in bones:
        if rng.random() < 0.35:
            way = synthetic_objects.random_direction(rng)
            middle = rig.tails[bone] + way * size * rng.uniform(0, 0.8)
            reach = way * size * rng.uniform(0.3, 2.5)
            flat = np.cross(way, rng.normal(size=3))
            span = (middle - 0.3 * reach, middle + 0.7 * reach)
            rig.add_capsule(bone, size * rng.uniform(0.15, 0.5), size * rng.uniform(0.1, 0.5), random_color(rng),
                            flat=flat, thin=rng.uniform(0.25, 1), segment=span, rigid=True)  # fmt: skip


def _add_spine(rig: RigBuilder, start: Array, way: Array, length: float, radius: float, color: Array) -> list[int]:
    """A row of bones with the trunk around them, some with a root bone; returns the bones of the trunk."""
    rng = rig.rng
    parent = rig.add_root(0.3)
    count = int(rng.integers(1, 5))
    wide = np.array([1.0, 0.0, 0.0])
    taper = rng.uniform(0.9, 1.1)
    return rig.add_chain(parent, start, way, np.full(count, length / count), radius, taper, color, bend=0.05,
                         flat=np.cross(way, wide), thin=rng.uniform(0.5, 1.0),
                         names=("Hips", "Spine", "Chest"))  # fmt: skip


def _add_legs(
    rig: RigBuilder, parent: int, hip: Array, height: float, radius: float, color: Array, tips: list[int]
) -> None:
    rng = rig.rng

    def leg() -> None:
        count = int(rng.integers(2, 5))
        share = rng.uniform(0.7, 1.3, count)
        way = np.array([rng.uniform(0, 0.3), rng.uniform(-0.2, 0.2), -1.0])
        made = rig.add_chain(parent, hip, way, height * share / share.sum(), radius, 0.8, color, bend=0.12, names=LEG)
        if rng.random() < 0.7:
            shoe = random_color(rng) if rng.random() < 0.5 else color
            at = rig.tails[made[-1]]
            foot = rig.add_bone(made[-1], at, at + np.array([0.05, -1.0, -0.15]) * radius * 2.5, "Foot")
            rig.add_capsule(foot, radius * 0.8, radius * 0.6, shoe)
        tips.append(made[-1])

    rig.add_mirrored(leg)


def _add_tail(
    rig: RigBuilder, parent: int, start: Array, way: Array, length: float, radius: float, color: Array
) -> None:
    count = int(rig.rng.integers(1, 7))
    rig.add_chain(parent, start, way, np.full(count, length / count), radius, 0.8, color, bend=0.2, names=("Tail",))


def _add_wings(rig: RigBuilder, parent: int, start: Array, span: float, color: Array) -> None:
    rng = rig.rng

    def wing() -> None:
        count = int(rng.integers(1, 4))
        hue = random_color(rng)
        rig.add_chain(parent, start, np.array([1.0, 0.3, 0.4]), np.full(count, span / count), span * 0.25, 0.8, hue,
                      bend=0.2, flat=np.array([0.0, 0.3, 1.0]), thin=0.15, names=("Wing",))  # fmt: skip

    rig.add_mirrored(wing)


def _build_biped(rig: RigBuilder) -> None:
    rng, color = rig.rng, random_color(rig.rng)
    trousers = random_color(rng) if rng.random() < 0.7 else color
    tall, stout = rng.uniform(0.5, 0.9), rng.uniform(0.12, 0.3)
    hip = np.array([0.0, 0.0, rng.uniform(0.4, 0.9)])
    spine = _add_spine(rig, hip, np.array([0.0, 0.0, 1.0]), tall, stout, color)
    top = rig.tails[spine[-1]]
    tips: list[int] = []
    first = len(rig.parents)
    _add_legs(rig, spine[0], hip + [0.6 * stout, 0, 0], hip[2], stout * rng.uniform(0.35, 0.6), trousers, tips)
    legs = list(range(first, len(rig.parents)))
    size, neck = rng.uniform(0.12, 0.35), spine[-1]
    if rng.random() < 0.7:
        neck = rig.add_chain(neck, top, np.array([0.0, 0, 1.0]), np.array([0.12]), 0.4 * size, 1.0, color, bend=0,
                             names=("Neck",))[0]  # fmt: skip
    head = _add_head(rig, neck, rig.tails[neck], np.array([0.0, 0, 1.0]), size, color)
    skin = random_color(rng) if rng.random() < 0.5 else color

    def arm() -> None:
        parent, start = spine[-1], top + [0.9 * stout, 0, -0.3 * stout]
        if rng.random() < 0.6:
            parent = rig.add_bone(parent, top - [0, 0, 0.1], start, "Shoulder")
        way = np.array([1.0, 0.0, rng.uniform(-1.5, 0.1)])
        reach, thick = rng.uniform(0.4, 0.9), stout * rng.uniform(0.25, 0.45)
        made = rig.add_chain(parent, start, way, np.array([0.5, 0.5]) * reach, thick, 0.85, skin, bend=0.15,
                             names=ARM)  # fmt: skip
        hand = rig.add_chain(made[-1], rig.tails[made[-1]], way, np.array([0.2 * reach]), thick, 1.0, skin, bend=0.1,
                             names=("Hand",))[0]  # fmt: skip
        for finger in range(int(rng.integers(0, 5)) if rng.random() < 0.4 else 0):
            along = way + [0.0, 0.5 * (finger - 2), 0]
            at = rig.tails[hand]
            rig.add_chain(hand, at, along, np.full(rng.integers(1, 4), 0.08 * reach), 0.3 * thick, 0.9, skin, bend=0.1,
                          names=("Finger",))  # fmt: skip
        tips.append(hand)

    rig.add_mirrored(arm)
    if rng.random() < 0.25:
        back, way = hip + [0, stout, 0], np.array([0.0, 1.0, -0.5])
        _add_tail(rig, spine[0], back, way, rng.uniform(0.3, 1.0), 0.4 * stout, color)
    if rng.random() < 0.2:
        _add_wings(rig, spine[-1], top + [0.3 * stout, stout, -0.1], rng.uniform(0.4, 1.0), color)
    _add_held_objects(rig, [tips[-1], head, spine[-1]], rng.uniform(0.15, 0.35))
    _add_clothes(rig, spine, legs, top, hip, tall, stout)
    for tip in tips[-2:]:
        if rng.random() < 0.25:
            clothes.add_weapon(rig, tip, rng.uniform(0.4, 0.9))


def _add_clothes(
    rig: RigBuilder, spine: list[int], legs: list[int], top: Array, hip: Array, tall: float, stout: float
) -> None:  # fmt: skip
    rng = rig.rng
    if rng.random() < 0.25:
        clothes.add_skirt(rig, spine[0], hip + [0, 0, 0.1], hip[2] * rng.uniform(0.3, 0.95), stout, legs)
    if rng.random() < 0.15:
        clothes.add_cape(rig, spine[-1], top + [0, stout, 0], tall * rng.uniform(0.6, 1.6), stout)
    if rng.random() < 0.2:
        clothes.add_bag(rig, spine[-1], top - [0, 0, 0.4 * tall], stout)
    for bone in range(spine[-1] + 1, len(rig.parents)):
        if rng.random() < 0.06:
            covered = [part.r0 for part in rig.capsules if part.bone == bone and not part.rigid]
            if covered:
                clothes.add_armour(rig, bone, max(covered))


def _build_quadruped(rig: RigBuilder) -> None:
    rng, color = rig.rng, random_color(rig.rng)
    high, long, stout = rng.uniform(0.3, 0.9), rng.uniform(0.6, 1.4), rng.uniform(0.14, 0.3)
    back = np.array([0.0, long / 2, high])
    spine = _add_spine(rig, back, np.array([0.0, -1.0, rng.uniform(-0.1, 0.2)]), long, stout, color)
    front, tips = rig.tails[spine[-1]], list[int]()
    thick = stout * rng.uniform(0.3, 0.5)
    for parent, at in ((spine[0], back), (spine[-1], front)):
        _add_legs(rig, parent, at + [0.6 * stout, 0, -0.3 * stout], high, thick, color, tips)
    count, way = int(rng.integers(1, 4)), np.array([0.0, -1.0, rng.uniform(0, 1.5)])
    long_neck = np.full(count, rng.uniform(0.2, 0.7) / count)
    neck = rig.add_chain(spine[-1], front, way, long_neck, 0.6 * stout, 0.85, color, bend=0.1, names=("Neck",))
    _add_head(rig, neck[-1], rig.tails[neck[-1]], np.array([0.0, -0.9, -0.1]), stout * rng.uniform(0.5, 0.9), color)
    if rng.random() < 0.8:
        _add_tail(rig, spine[0], back, np.array([0.0, 1.0, -0.3]), rng.uniform(0.2, 1.0), 0.3 * stout, color)
    if rng.random() < 0.2:
        _add_wings(rig, spine[-1], front + [0.3 * stout, 0, 0.8 * stout], rng.uniform(0.5, 1.2), color)
    _add_held_objects(rig, [spine[0], spine[-1]], 0.25)


def _build_crawler(rig: RigBuilder) -> None:
    rng, color = rig.rng, random_color(rig.rng)
    high, long, stout = rng.uniform(0.15, 0.5), rng.uniform(0.4, 1.2), rng.uniform(0.12, 0.3)
    back = np.array([0.0, long / 2, high])
    spine = _add_spine(rig, back, np.array([0.0, -1.0, 0.0]), long, stout, color)
    hue = random_color(rng) if rng.random() < 0.5 else color
    pairs = int(rng.integers(2, 6))
    for number in range(pairs):
        share = (number + 0.5) / pairs
        at = back + [0.8 * stout, -long * share, 0]
        parent = spine[min(int(share * len(spine)), len(spine) - 1)]

        def leg(at: Array = at, parent: int = parent, lean: float = share - 0.5) -> None:
            thigh = np.full(1, rng.uniform(0.15, 0.4))
            made = rig.add_chain(parent, at, np.array([1.0, -lean, 0.6]), thigh, 0.06, 0.9, hue, names=("Leg",))
            way = np.array([0.7, -lean, -1.0])
            rig.add_chain(made[-1], rig.tails[made[-1]], way, np.full(rng.integers(1, 3), 0.3), 0.05, 0.7, hue,
                          bend=0.1, names=("Leg",))  # fmt: skip

        rig.add_mirrored(leg)
    _add_head(rig, spine[-1], rig.tails[spine[-1]], np.array([0.0, -1.0, 0.0]), 0.7 * stout, color)
    if rng.random() < 0.3:
        _add_tail(rig, spine[0], back, np.array([0.0, 1.0, 0.5]), rng.uniform(0.3, 1.0), 0.3 * stout, color)


def _build_swimmer(rig: RigBuilder) -> None:
    """Snakes and fish."""
    rng, color = rig.rng, random_color(rig.rng)
    count, long, stout = int(rng.integers(3, 14)), rng.uniform(1.0, 2.0), rng.uniform(0.06, 0.25)
    parent = rig.add_root(0.3)
    made = rig.add_chain(parent, np.zeros(3), np.array([0.0, 1.0, 0.0]), np.full(count, long / count), stout, 0.9,
                         color, bend=rng.uniform(0, 0.2), flat=np.array([1.0, 0, 0]), thin=rng.uniform(0.5, 1),
                         names=("Spine",))  # fmt: skip
    _add_head(rig, made[0], rig.heads[made[0]], np.array([0.0, -1.0, 0.0]), stout * rng.uniform(0.6, 1.1), color)
    if rng.random() < 0.6:
        at, hue = rig.heads[made[count // 3]], random_color(rng)
        flat = np.array([0.0, 0.2, 1.0])

        def fin() -> None:
            start, reach = at + [0.4 * stout, 0, 0], np.array([2 * stout])
            way = np.array([1.0, 0.8, 0.0])
            bone = rig.add_chain(made[count // 3], start, way, reach, 0.5 * stout, 0.6, hue, flat=flat, thin=0.2,
                                 names=("Fin",))[0]  # fmt: skip
            rig.add_capsule(bone, 0.4 * stout, 0.3 * stout, hue, flat=flat, thin=0.2)

        rig.add_mirrored(fin)


KINDS = (
    (_build_biped, 4.0), (_build_quadruped, 2.5), (_build_crawler, 1.5), (_build_swimmer, 1.5),
    (synthetic_objects.build_machine, 1.5), (synthetic_objects.build_plant, 1.0),
    (synthetic_objects.build_round_creature, 1.2), (synthetic_objects.build_banner, 0.6),
    (synthetic_objects.build_hand, 0.6),
)  # fmt: skip
"""Builders of creatures, and how often each is drawn relative to the others."""
