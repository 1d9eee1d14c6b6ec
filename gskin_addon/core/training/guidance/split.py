# SPDX-License-Identifier: GPL-3.0-or-later
"""Which assets train and which validate: whole families only, since families share rigs and meshes."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Collection, Sequence

from ...errors import InputError
from ..catalogue import Asset

TRAIN, VALIDATION = "train", "validation"


def split_families(
    assets: Sequence[Asset], share: float, seed: int, *, leave_out: Collection[str] = (), per_family: int = 0
) -> dict[str, list[Asset]]:
    """Assets by split, the same for the same seed; no family is in both.

    About `share` (0 to 1) of the assets validate: families in a random order, each taken while it fits. At least
    one family validates where there are two. `leave_out`: families for neither; `per_family`: at most so many
    assets of one family (a random choice), 0 for all.

    Raises:
        InputError: `leave_out` names a family that is not there, or leaves nothing.
    """
    families: dict[str, list[Asset]] = defaultdict(list)
    for asset in assets:
        families[asset.family].append(asset)
    unknown = sorted(set(leave_out) - set(families))
    if unknown:
        raise InputError(f"There is no family '{unknown[0]}' to leave out; there are {', '.join(sorted(families))}.")
    kept = {name: _few(members, per_family, seed) for name, members in families.items() if name not in leave_out}
    if not kept:
        raise InputError("Every family is left out; keep some to learn from.")
    total = sum(len(members) for members in kept.values())
    order = sorted(kept, key=lambda name: _draw(seed, name))
    validating: set[str] = set()
    room = share * total
    for name in order:
        if len(kept[name]) <= room:
            validating.add(name)
            room -= len(kept[name])
    if not validating and share > 0 and len(kept) > 1:
        validating = {min(order, key=lambda name: len(kept[name]))}
    chosen: dict[str, list[Asset]] = {TRAIN: [], VALIDATION: []}
    for name in order:
        chosen[VALIDATION if name in validating else TRAIN] += kept[name]
    return {split: sorted(members, key=lambda asset: asset.name) for split, members in chosen.items()}


def _few(members: list[Asset], count: int, seed: int) -> list[Asset]:
    drawn = sorted(members, key=lambda asset: _draw(seed, asset.name))
    return drawn[:count] if count else members


def _draw(seed: int, name: str) -> bytes:
    return hashlib.blake2b(f"{seed} {name}".encode(), digest_size=8).digest()
