# SPDX-License-Identifier: GPL-3.0-or-later
"""Which samples a training uses, and the folds of the held-out evaluation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import InputError
from ..catalogue import Asset
from .samples import TrainingSample, asset_sample, creature_sample

CREATURES = "made by gskin"
"""The family of the synthetic creatures."""

FAMILY_FACTORS = {"Animalia": 0.25}
"""Factors on the chance of a family: these are boxes with rigid weights."""

PER_FAMILY = 14
"""Samples of a family, per square root of its number of assets: large families have many similar ones."""

ALWAYS_LEFT_OUT = ("OpenDungeons",)
"""Families that no model is trained on: mostly share-alike works, which test the shipped model."""

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
"""Similar families are left out together, so that every asset of the evaluation is tested with a model that was not
trained on its family."""


@dataclass(frozen=True)
class SampleRequest:
    """One sample to make: an asset's name, family and npz file (None for a creature), and the variant."""

    name: str
    family: str
    npz: Path | None
    variant: int

    def make(self, cache: Path) -> Path:
        """Make the sample unless it is in the cache; returns its path."""
        if self.npz is None:
            return creature_sample(self.variant, cache)
        return asset_sample(self.npz, self.name, self.variant, cache)


class SamplingPlan:
    """Sample files by family and asset; large families count for less than their size."""

    def __init__(self, files: dict[str, dict[str, list[Path]]]) -> None:
        """files: family -> asset -> its samples. Raises InputError if there are none."""
        self.files = {family: list(assets.values()) for family, assets in sorted(files.items()) if assets}
        if not self.files:
            raise InputError("There is nothing to learn from: every family of the catalogue is left out.")
        count = np.array([len(assets) ** 0.65 * FAMILY_FACTORS.get(name, 1.0) for name, assets in self.files.items()])
        self._chance = count / count.sum()

    def draw(self, count: int, rng: np.random.Generator) -> list[TrainingSample]:
        """`count` samples of different families, if there are enough families."""
        families = list(self.files)
        replace = count > len(families)
        picked = rng.choice(len(families), count, replace=replace, p=self._chance)
        out = []
        for number in picked:
            assets = self.files[families[number]]
            samples = assets[rng.integers(len(assets))]
            out.append(TrainingSample.load(samples[rng.integers(len(samples))]))
        return out


def plan_samples(assets: Sequence[Asset], leave_out: Sequence[str], creatures: int) -> list[SampleRequest]:
    """The samples of all families but those left out; a family's samples are the same in every fold."""
    families: dict[str, list[Asset]] = {}
    for asset in assets:
        if asset.family not in leave_out:
            families.setdefault(asset.family, []).append(asset)
    rounds: dict[int, list[SampleRequest]] = {}
    for family, members in families.items():
        wanted = math.ceil(PER_FAMILY * math.sqrt(len(members)))
        for number in range(max(wanted, len(members))):
            asset, variant = members[number % len(members)], number // len(members)
            rounds.setdefault(variant, []).append(SampleRequest(asset.name, family, asset.path, variant))
    for seed in range(creatures):
        rounds.setdefault(seed // 40, []).append(SampleRequest("creature", CREATURES, None, seed))
    return [request for _, some in sorted(rounds.items()) for request in some]


def make_samples(
    requests: Sequence[SampleRequest], cache: Path, report: Callable[[int, int], None]
) -> SamplingPlan:
    """Make the missing samples; `report` is called with the number of those done and of all."""
    cache.mkdir(parents=True, exist_ok=True)
    files: dict[str, dict[str, list[Path]]] = {}
    for number, request in enumerate(requests):
        report(number, len(requests))
        asset = request.name if request.npz is not None else f"{request.name} {request.variant}"
        files.setdefault(request.family, {}).setdefault(asset, []).append(request.make(cache))
    return SamplingPlan(files)
