# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthetic objects other than animals: plants, machines, banners, hands, and round creatures such as fruit with
faces."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .capsules import RigBuilder

Array = NDArray[Any]
UP = np.array([0.0, 0.0, 1.0])


def random_color(rng: np.random.Generator) -> Array:
    """A random colour (3,), neither black nor white."""
    return rng.uniform(0.05, 0.95, 3)


def random_direction(rng: np.random.Generator) -> Array:
    """A random unit vector."""
    way = rng.normal(size=3)
    out: Array = way / np.linalg.norm(way)
    return out


def build_plant(rig: RigBuilder) -> None:
    """A trunk with branches and crowns of leaves, which follow the last bone of their branch."""
    rng = rig.rng
    bark, leaf = random_color(rng), random_color(rng)
    count, tall, thick = int(rng.integers(1, 6)), rng.uniform(0.7, 1.5), rng.uniform(0.04, 0.2)
    parent = rig.add_root(0.4)
    trunk = rig.add_chain(parent, np.zeros(3), UP, np.full(count, tall / count), thick, 0.85, bark, bend=0.1)
    crown = rng.uniform(0.2, 0.6)

    def leaves(bone: int, at: Array, size: float) -> None:
        for _ in range(int(rng.integers(1, 4))):
            middle = at + size * rng.normal(0, 0.4, 3)
            radius = size * rng.uniform(0.5, 1.0)
            end = middle + 0.3 * size * random_direction(rng)
            rig.add_capsule(bone, radius, radius * rng.uniform(0.5, 1), leaf, segment=(middle, end),
                            rigid=rng.random() < 0.6, flat=UP, thin=rng.uniform(0.3, 1))  # fmt: skip

    for _ in range(int(rng.integers(0, 6))):
        bone = trunk[int(rng.integers(len(trunk)))]
        start = rig.heads[bone] + rng.uniform(0.3, 1.0) * (rig.tails[bone] - rig.heads[bone])
        way = random_direction(rng) + 0.5 * UP
        bones = int(rng.integers(1, 4))
        reach = rng.uniform(0.3, 0.8)
        branch = rig.add_chain(bone, start, way, np.full(bones, reach / bones), 0.5 * thick, 0.7, bark, bend=0.2)
        if rng.random() < 0.8:
            leaves(branch[-1], rig.tails[branch[-1]], 0.6 * crown)
    if rng.random() < 0.7:
        leaves(trunk[-1], rig.tails[trunk[-1]], crown)
    if rng.random() < 0.3:  # a mushroom's hat
        at = rig.tails[trunk[-1]]
        rig.add_capsule(trunk[-1], crown, 0.6 * crown, leaf, segment=(at, at + 0.15 * UP), flat=UP,
                        thin=rng.uniform(0.3, 0.8))  # fmt: skip


def build_machine(rig: RigBuilder) -> None:
    """Rigid parts that turn about joints; parts may be away from the bone that moves them."""
    rng = rig.rng
    colors = [random_color(rng) for _ in range(3)]

    def part(bone: int, start: Array, end: Array, radius: float) -> None:
        for _ in range(int(rng.integers(1, 4))):
            shift = radius * rng.normal(0, 0.5, 3)
            rig.add_capsule(bone, radius * rng.uniform(0.5, 1.2), radius * rng.uniform(0.4, 1.2),
                            colors[rng.integers(3)], segment=(start + shift, end + shift), flat=random_direction(rng),
                            thin=rng.uniform(0.3, 1), rigid=True)  # fmt: skip

    high, size = rng.uniform(0.3, 1.0), rng.uniform(0.15, 0.4)
    root = rig.add_root(0.5)
    hull_at = high * UP
    way = UP if rng.random() < 0.5 else np.array([0.0, -1.0, 0.0])
    hull = rig.add_bone(root, hull_at, hull_at + size * way, "Body")
    part(hull, hull_at - [0, size, 0], hull_at + [0, size, 0], size)
    if rng.random() < 0.3:  # more bones inside the hull, which move little of it
        inner = hull
        for name in ("Chest", "Neck")[: int(rng.integers(1, 3))]:
            at = rig.tails[inner]
            inner = rig.add_bone(inner, at, at + 0.4 * size * UP, name)
            part(inner, at + 0.2 * size * UP, at + 0.4 * size * UP, 0.25 * size)
    if rng.random() < 0.7:
        seat = hull_at + size * UP
        turret = rig.add_bone(hull, seat, seat + 0.5 * size * UP)
        part(turret, seat, seat + 0.5 * size * UP, 0.6 * size)
        if rng.random() < 0.7:
            mouth = seat + [0.0, -0.6 * size, 0.3 * size]
            barrel = rig.add_bone(turret, mouth, mouth - [0, 0.5, 0], "Gun") if rng.random() < 0.6 else turret
            part(barrel, mouth, mouth - [0, rng.uniform(0.3, 0.9), 0], 0.15 * size)

    for _ in range(int(rng.integers(1, 4))):
        place = np.array([size, rng.uniform(-1, 1) * size, 0.0])
        kind = rng.random()

        def limb(place: Array = place, kind: float = kind) -> None:
            at = hull_at + place
            if kind < 0.25:  # a wheel
                middle = at * [1.2, 1, 0] + [0, 0, 0.5 * high]
                wheel = rig.add_bone(hull, middle, middle + [0.2, 0, 0], "Wheel")
                rig.add_capsule(wheel, 0.45 * high, 0.45 * high, colors[0], segment=(middle, middle + [0.01, 0, 0]),
                                flat=np.array([1.0, 0, 0]), thin=0.3, rigid=True)  # fmt: skip
                return
            bones, parent = int(rng.integers(2, 4)), hull
            down = np.array([rng.uniform(0, 0.6), rng.uniform(-0.3, 0.3), -1.0])
            if kind >= 0.7:
                down[2] = rng.uniform(-0.5, 0.5)
            for _ in range(bones):
                end = at + down / np.linalg.norm(down) * high / bones
                parent = rig.add_bone(parent, at, end if rng.random() < 0.7 else at + 0.3 * (end - at))
                part(parent, at, end, size * rng.uniform(0.15, 0.35))
                at, down = end, down + rng.normal(0, 0.5, 3)

        rig.add_mirrored(limb)


def build_banner(rig: RigBuilder) -> None:
    """Cloth that hangs on a pole, or a rope or chain of links."""
    rng = rig.rng
    tall, wide = rng.uniform(0.6, 1.2), rng.uniform(0.2, 0.8)
    pole = rig.add_bone(-1, np.zeros(3), tall * UP)
    if rng.random() < 0.8:
        rig.add_capsule(pole, 0.03, 0.03, random_color(rng), rigid=True)
        bar = (tall * UP - [wide / 2, 0, 0], tall * UP + [wide / 2, 0, 0])
        rig.add_capsule(pole, 0.03, 0.03, random_color(rng), segment=bar, rigid=True)
    columns, rows, hue = int(rng.integers(1, 4)), int(rng.integers(2, 6)), random_color(rng)
    length = rng.uniform(0.4, 0.9) * tall
    for column in range(columns):
        at = np.array([wide * ((column + 0.5) / columns - 0.5), 0.0, tall])
        rig.add_chain(pole, at, -UP, np.full(rows, length / rows), 0.55 * wide / columns, 1.0, hue, bend=0.05,
                      flat=np.array([0.0, 1.0, 0.0]), thin=rng.uniform(0.05, 0.3))  # fmt: skip
    if rng.random() < 0.5:
        at = tall * UP
        rig.add_capsule(pole, 0.06, 0.1, random_color(rng), segment=(at, at + 0.1 * UP), rigid=True)


def build_hand(rig: RigBuilder) -> None:
    """A forearm's end, a palm and fingers."""
    rng, skin = rig.rng, random_color(rig.rng)
    sleeve = random_color(rng) if rng.random() < 0.5 else skin
    size = rng.uniform(0.3, 0.6)
    wrist = rig.add_chain(-1, np.zeros(3), UP, np.array([rng.uniform(0.3, 0.8)]), 0.5 * size, 0.9, sleeve, bend=0,
                          names=("Forearm",))[0]  # fmt: skip
    palm = rig.add_chain(wrist, rig.tails[wrist], UP, np.array([size]), 0.55 * size, 1.1, skin, bend=0,
                         flat=np.array([0.0, 1.0, 0.0]), thin=rng.uniform(0.3, 0.7), names=("Hand",))[0]  # fmt: skip
    top, fingers = rig.tails[palm], int(rng.integers(3, 6))
    for number in range(fingers):
        place = (number / max(fingers - 1, 1) - 0.5) * size
        thumb = number == 0
        start = top + [place, 0, 0] if not thumb else rig.heads[palm] + [-0.5 * size, 0, 0.3 * size]
        way = UP + [place / size * (3.0 if thumb else 0.4), -0.2 * rng.random(), 0]
        parent = palm
        if rng.random() < 0.5:  # a bone inside the palm
            parent = rig.add_bone(palm, rig.heads[palm] + 0.2 * (start - rig.heads[palm]), start, "Metacarpal")
        joints = int(rng.integers(2, 4))
        reach = size * rng.uniform(0.6, 1.1)
        rig.add_chain(parent, start, way, np.full(joints, reach / joints), 0.13 * size, 0.9, skin, bend=0.1,
                      names=("Thumb" if thumb else "Finger",))  # fmt: skip


def build_round_creature(rig: RigBuilder) -> None:
    """A round body with few bones (fruit, slimes, eggs), with random arms, legs, wings, eyes and leaves."""
    rng, skin = rig.rng, random_color(rig.rng)
    size, high = rng.uniform(0.3, 0.6), rng.uniform(0.0, 0.4)
    parent = rig.add_root(0.5)
    start = (high + 0.3 * size) * UP
    count = int(rng.integers(1, 4))
    tall = size * rng.uniform(0.5, 1.6)
    body = rig.add_chain(parent, start, UP, np.full(count, tall / count), size, rng.uniform(0.7, 1.2), skin, bend=0.03,
                         names=("Body",))  # fmt: skip
    top, middle = rig.tails[body[-1]], 0.5 * (start + rig.tails[body[-1]])
    face = body[-1]
    if rng.random() < 0.7:
        hue, eye = random_color(rng), middle + size * np.array([0.35, -0.95, 0.2])
        own = rng.random() < 0.3

        def add_eye() -> None:
            bone = rig.add_bone(face, eye, eye - [0, 0.1 * size, 0], "Eye") if own else face
            rig.add_capsule(bone, 0.15 * size, 0.15 * size, hue, segment=(eye, eye + 1e-3), rigid=True)

        rig.add_mirrored(add_eye)
    for reach, place, way in (
        (rng.uniform(0.3, 0.8), middle + [0.9 * size, 0, 0], np.array([1.0, 0.0, rng.uniform(-1, 0.5)])),
        (high + 0.1, start + [0.4 * size, 0, -0.6 * size], -UP),
    ):
        if rng.random() < 0.6:
            hue, joints = random_color(rng) if rng.random() < 0.5 else skin, int(rng.integers(1, 4))

            def limb(
                reach: float = reach, place: Array = place, way: Array = way, hue: Array = hue, joints: int = joints
            ) -> None:
                lengths = np.full(joints, reach / joints)
                made = rig.add_chain(body[0], place, way, lengths, 0.12 * size, 0.9, hue, bend=0.1)
                at = rig.tails[made[-1]]
                rig.add_capsule(made[-1], 0.2 * size, 0.2 * size, hue, segment=(at, at + 1e-3), rigid=True)

            rig.add_mirrored(limb)
    if rng.random() < 0.35:
        hue, joints, span = random_color(rng), int(rng.integers(2, 5)), size * rng.uniform(1.0, 2.5)
        place, way = middle + size * np.array([0.7, 0.4, 0.2]), np.array([1.0, 0.3, rng.uniform(-0.2, 0.8)])

        def wing() -> None:
            rig.add_chain(body[count // 2], place, way, np.full(joints, span / joints), 0.3 * span, 0.7, hue, bend=0.15,
                          flat=np.array([0.0, 0.4, 1.0]), thin=0.12, names=("Wing",))  # fmt: skip

        rig.add_mirrored(wing)
    for _ in range(int(rng.integers(0, 4))):
        way = UP + 0.7 * random_direction(rng)
        leaf, hue = rng.uniform(0.2, 0.6) * size, random_color(rng)
        if rng.random() < 0.4:
            at, lengths = top + 0.7 * size * UP, np.full(2, leaf)
            rig.add_chain(body[-1], at, way, lengths, 0.2 * size, 0.6, hue, flat=UP, thin=0.3)
        else:
            at = top + 0.8 * size * UP
            rig.add_capsule(body[-1], 0.2 * size, 0.1 * size, hue, segment=(at, at + leaf * way), rigid=True)
