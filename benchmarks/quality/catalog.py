# SPDX-License-Identifier: GPL-3.0-or-later
"""Which assets the benchmark runs on: the catalogue's evaluation candidates, or a balanced part of them."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from benchmarks.assets import ASSETS
from gskin_addon.core.training.catalogue import FREE_LICENCES

CATEGORIES = ("humanoid", "animal", "creature", "object")


@dataclass(frozen=True)
class Entry:
    """An asset of the catalogue. Assets of one family share rigs or meshes."""

    name: str
    category: str
    family: str


@cache
def _catalogue(folder: Path) -> dict[str, dict[str, object]]:
    entries = json.loads((folder / "catalog.json").read_text(encoding="utf-8"))["assets"]
    return {entry["name"]: entry for entry in entries}


def candidates(folder: Path = ASSETS) -> list[Entry]:
    """All that may be evaluated on, without near duplicates, by name."""
    return [
        Entry(name, str(entry["category"]), str(entry["family"]))
        for name, entry in sorted(_catalogue(folder).items())
        if entry.get("eval_candidate") and not entry.get("near_duplicate_of")
    ]


def family_of(name: str, folder: Path = ASSETS) -> str:
    """The family of an asset; KeyError if there is no such asset."""
    return str(_catalogue(folder)[name]["family"])


def is_open(name: str, folder: Path = ASSETS) -> bool:
    """Whether an asset's licence asks for no more than its author's name; KeyError if there is no such asset."""
    return _catalogue(folder)[name]["license"] in FREE_LICENCES


def entry_of(name: str, folder: Path = ASSETS) -> Entry:
    """The entry of an asset, also of one that is no candidate; KeyError if there is no such asset."""
    entry = _catalogue(folder)[name]
    return Entry(name, str(entry["category"]), str(entry["family"]))


def balanced(entries: Sequence[Entry], count: int) -> list[Entry]:
    """`count` of the entries: categories take turns, inside each the families do; always the same ones.

    A larger count contains the smaller ones.
    """
    left = sorted(entries, key=lambda e: hashlib.sha1(e.name.encode()).hexdigest())
    chosen: list[Entry] = []
    categories, families = Counter[str](), Counter[tuple[str, str]]()
    while left and len(chosen) < count:
        best = min(
            left,
            key=lambda e: (categories[e.category], CATEGORIES.index(e.category), families[e.category, e.family]),
        )
        left.remove(best)
        chosen.append(best)
        categories[best.category] += 1
        families[best.category, best.family] += 1
    return chosen
