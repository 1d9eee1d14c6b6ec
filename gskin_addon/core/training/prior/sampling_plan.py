# SPDX-License-Identifier: GPL-3.0-or-later
"""Which lessons a training is made of, and the folds of the held-out evaluation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..catalogue import Asset
from .samples import asset_lesson, creature_lesson
from .train import CREATURES, Syllabus

PER_FAMILY = 14
"""Lessons of a family, times the square root of its number of assets: large families have many alike."""

NEVER = ("OpenDungeons",)
"""Families that no model of ours sees: mostly share-alike works, and the test of the shipped model."""

FOLDS: dict[str, tuple[str, ...]] = {
    "people": ("Quaternius 2016-2019",),
    "clonk": ("OpenClonk",),
    "monsters": ("Quaternius ultimate monsters", "Quaternius cute monsters"),
    "animals": ("Quaternius animated animals", "Quaternius fish", "Quaternius cute fish"),
    "others": (
        "Quaternius space", "Quaternius mechs", "Quaternius cyberpunk", "gd_platformer_robot",
        "Quaternius easy enemies", "Quaternius platformer", "gd_platformer_enemy", "q_alien_scolitex",
        "q_single_knight_KnightCharacter",
    ),
}  # fmt: skip
"""Families left out together, those of one kind, so that each asset for evaluation is judged by a model that never saw
its family."""


@dataclass(frozen=True)
class Request:
    """One lesson to make: an asset's name, family and npz file (None for a creature), and the variant."""

    name: str
    family: str
    npz: Path | None
    variant: int

    def make(self, cache: Path) -> Path:
        """Make it, unless it is in the cache; returns its file."""
        if self.npz is None:
            return creature_lesson(self.variant, cache)
        return asset_lesson(self.npz, self.name, self.variant, cache)


def plan(assets: Sequence[Asset], leave_out: Sequence[str], creatures: int) -> list[Request]:
    """The lessons of all families but those left out; what is the same in every fold comes out the same."""
    families: dict[str, list[Asset]] = {}
    for asset in assets:
        if asset.family not in leave_out:
            families.setdefault(asset.family, []).append(asset)
    rounds: dict[int, list[Request]] = {}
    for family, members in families.items():
        wanted = math.ceil(PER_FAMILY * math.sqrt(len(members)))
        for number in range(max(wanted, len(members))):
            asset, variant = members[number % len(members)], number // len(members)
            rounds.setdefault(variant, []).append(Request(asset.name, family, asset.path, variant))
    for seed in range(creatures):
        rounds.setdefault(seed // 40, []).append(Request("creature", CREATURES, None, seed))
    return [request for _, some in sorted(rounds.items()) for request in some]


def collect(requests: Sequence[Request], cache: Path, tell: Callable[[int, int], None]) -> Syllabus:
    """Make the lessons that are missing; `tell` hears how many of how many are there."""
    cache.mkdir(parents=True, exist_ok=True)
    files: dict[str, dict[str, list[Path]]] = {}
    for number, request in enumerate(requests):
        tell(number, len(requests))
        asset = request.name if request.npz is not None else f"{request.name} {request.variant}"
        files.setdefault(request.family, {}).setdefault(asset, []).append(request.make(cache))
    return Syllabus(files)
