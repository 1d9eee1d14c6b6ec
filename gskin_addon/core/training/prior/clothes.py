# SPDX-License-Identifier: GPL-3.0-or-later
"""What synthetic creatures wear and carry: skirts, capes, hair, armour, bags, weapons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .capsules import RigBuilder
from .synthetic_objects import UP, random_color, random_direction

Array = NDArray[Any]
BACK = np.array([0.0, 1.0, 0.0])


def add_skirt(rig: RigBuilder, hip: int, at: Array, length: float, radius: float, legs: Sequence[int]) -> None:
    """A cone around the legs, from the hip down: it follows the hip, and further down increasingly the legs."""
    rng = rig.rng
    flare, sag = rng.uniform(0.9, 1.8), rng.choice([0.0, rng.uniform(0.3, 1.0)])
    rig.add_capsule(hip, radius, flare * radius, random_color(rng), segment=(at, at - length * UP), flat=BACK,
                    thin=rng.uniform(0.6, 1.0), drape=tuple(legs), sag=float(sag))  # fmt: skip


def add_cape(rig: RigBuilder, chest: int, at: Array, length: float, width: float) -> None:
    """A sheet down the back: rigid with the chest, or with bones of its own."""
    rng, hue = rig.rng, random_color(rig.rng)
    way, thin = -UP + rng.uniform(0, 0.4) * BACK, rng.uniform(0.05, 0.2)
    if rng.random() < 0.5:
        count = int(rng.integers(1, 5))
        lengths = np.full(count, length / count)
        rig.add_chain(chest, at, way, lengths, width, 1.05, hue, bend=0.05, flat=BACK, thin=thin,
                      names=("Cape",))  # fmt: skip
    else:
        span = (at, at + length * way)
        rig.add_capsule(chest, width, 1.2 * width, hue, segment=span, flat=BACK, thin=thin, rigid=True)


def add_hair(rig: RigBuilder, head: int, at: Array, size: float) -> None:
    """Strands or a mane that hang over neck and shoulders and follow the head."""
    rng, hue = rig.rng, random_color(rig.rng)
    length = size * rng.uniform(0.8, 3.0)
    way = -UP + rng.uniform(0.1, 0.5) * BACK
    if rng.random() < 0.3:
        rig.add_chain(head, at, way, np.full(rng.integers(1, 4), 0.5 * length), 0.3 * size, 0.8, hue, bend=0.1,
                      names=("Hair",))  # fmt: skip
        return
    rig.add_capsule(head, 0.7 * size, rng.uniform(0.2, 0.9) * size, hue, segment=(at, at + length * way), flat=BACK,
                    thin=rng.uniform(0.3, 1.0), rigid=True)  # fmt: skip


def add_armour(rig: RigBuilder, bone: int, size: float) -> None:
    """Something rigid around a limb: shoulder pads, bracers, cuffs, boots."""
    rng = rig.rng
    start, end = rig.heads[bone], rig.tails[bone]
    a, b = sorted(rng.uniform(-0.2, 1.0, 2))
    rig.add_capsule(bone, size * rng.uniform(1.1, 1.7), size * rng.uniform(0.9, 1.7), random_color(rng),
                    segment=(start + a * (end - start), start + b * (end - start)), rigid=True)  # fmt: skip


def add_bag(rig: RigBuilder, chest: int, at: Array, size: float) -> None:
    """A rucksack, a quiver or a tank on the back."""
    rng = rig.rng
    middle = at + size * rng.uniform(0.8, 1.3) * BACK
    rig.add_capsule(chest, size * rng.uniform(0.4, 0.9), size * rng.uniform(0.3, 0.9), random_color(rng),
                    segment=(middle, middle + size * rng.uniform(-1.2, 1.2) * UP), flat=BACK, thin=rng.uniform(0.4, 1),
                    rigid=True)  # fmt: skip


def add_weapon(rig: RigBuilder, hand: int, reach: float) -> None:
    """A long thing in a hand, which may touch or cross the body, with a bone of its own or without."""
    rng, hue = rig.rng, random_color(rig.rng)
    way, at = random_direction(rng), rig.tails[hand]
    length, back = reach * rng.uniform(0.6, 2.0), rng.uniform(0.0, 0.5)
    start, end = at - back * length * way, at + (1 - back) * length * way
    bone = rig.add_bone(hand, at, at + 0.2 * length * way, "Weapon") if rng.random() < 0.25 else hand
    thick, flat = reach * rng.uniform(0.03, 0.08), random_direction(rng)
    rig.add_capsule(bone, thick, thick, hue, segment=(start, end), rigid=True)
    if rng.random() < 0.7:  # a blade, a head or a shield
        rig.add_capsule(bone, thick * rng.uniform(1.5, 6), thick * rng.uniform(1, 5), random_color(rng),
                        segment=(at + rng.uniform(0.2, 0.7) * (end - at), end), flat=flat, thin=rng.uniform(0.1, 1),
                        rigid=True)  # fmt: skip
