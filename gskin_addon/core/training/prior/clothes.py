# SPDX-License-Identifier: GPL-3.0-or-later
"""What made-up bodies wear and carry: skirts, capes, hair, armour, bags, weapons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .capsules import Plan
from .synthetic_objects import UP, direction, random_color

Array = NDArray[Any]
BACK = np.array([0.0, 1.0, 0.0])


def skirt(plan: Plan, hip: int, at: Array, length: float, radius: float, legs: Sequence[int]) -> None:
    """A cone about the legs, from the hip down: it follows the hip, further down more and more the legs."""
    rng = plan.rng
    flare, sag = rng.uniform(0.9, 1.8), rng.choice([0.0, rng.uniform(0.3, 1.0)])
    plan.cover(hip, radius, flare * radius, random_color(rng), segment=(at, at - length * UP), flat=BACK,
               thin=rng.uniform(0.6, 1.0), drape=tuple(legs), sag=float(sag))  # fmt: skip


def cape(plan: Plan, chest: int, at: Array, length: float, width: float) -> None:
    """A sheet down the back: of the chest, or with bones of its own."""
    rng, hue = plan.rng, random_color(plan.rng)
    way, thin = -UP + rng.uniform(0, 0.4) * BACK, rng.uniform(0.05, 0.2)
    if rng.random() < 0.5:
        count = int(rng.integers(1, 5))
        lengths = np.full(count, length / count)
        plan.chain(chest, at, way, lengths, width, 1.05, hue, bend=0.05, flat=BACK, thin=thin,
                   names=("Cape",))  # fmt: skip
    else:
        plan.cover(chest, width, 1.2 * width, hue, segment=(at, at + length * way), flat=BACK, thin=thin, rigid=True)


def hair(plan: Plan, head: int, at: Array, size: float) -> None:
    """Strands or a mane that hang over neck and shoulders and follow the head."""
    rng, hue = plan.rng, random_color(plan.rng)
    length = size * rng.uniform(0.8, 3.0)
    way = -UP + rng.uniform(0.1, 0.5) * BACK
    if rng.random() < 0.3:
        plan.chain(head, at, way, np.full(rng.integers(1, 4), 0.5 * length), 0.3 * size, 0.8, hue, bend=0.1,
                   names=("Hair",))  # fmt: skip
        return
    plan.cover(head, 0.7 * size, rng.uniform(0.2, 0.9) * size, hue, segment=(at, at + length * way), flat=BACK,
               thin=rng.uniform(0.3, 1.0), rigid=True)  # fmt: skip


def pads(plan: Plan, bone: int, size: float) -> None:
    """Something stiff about a limb: shoulder pads, bracers, cuffs, boots."""
    rng = plan.rng
    start, end = plan.heads[bone], plan.tails[bone]
    a, b = sorted(rng.uniform(-0.2, 1.0, 2))
    plan.cover(bone, size * rng.uniform(1.1, 1.7), size * rng.uniform(0.9, 1.7), random_color(rng),
               segment=(start + a * (end - start), start + b * (end - start)), rigid=True)  # fmt: skip


def bag(plan: Plan, chest: int, at: Array, size: float) -> None:
    """A rucksack, a quiver or a tank on the back."""
    rng = plan.rng
    middle = at + size * rng.uniform(0.8, 1.3) * BACK
    plan.cover(chest, size * rng.uniform(0.4, 0.9), size * rng.uniform(0.3, 0.9), random_color(rng),
               segment=(middle, middle + size * rng.uniform(-1.2, 1.2) * UP), flat=BACK, thin=rng.uniform(0.4, 1),
               rigid=True)  # fmt: skip


def weapon(plan: Plan, hand: int, reach: float) -> None:
    """A long thing in a hand, which may touch or cross the body, with a bone of its own or without."""
    rng, hue = plan.rng, random_color(plan.rng)
    way, at = direction(rng), plan.tails[hand]
    length, back = reach * rng.uniform(0.6, 2.0), rng.uniform(0.0, 0.5)
    start, end = at - back * length * way, at + (1 - back) * length * way
    bone = plan.bone(hand, at, at + 0.2 * length * way, "Weapon") if rng.random() < 0.25 else hand
    thick, flat = reach * rng.uniform(0.03, 0.08), direction(rng)
    plan.cover(bone, thick, thick, hue, segment=(start, end), rigid=True)
    if rng.random() < 0.7:  # a blade, a head or a shield
        plan.cover(bone, thick * rng.uniform(1.5, 6), thick * rng.uniform(1, 5), random_color(rng),
                   segment=(at + rng.uniform(0.2, 0.7) * (end - at), end), flat=flat, thin=rng.uniform(0.1, 1),
                   rigid=True)  # fmt: skip
