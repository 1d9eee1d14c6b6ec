# SPDX-License-Identifier: GPL-3.0-or-later
"""How often a rig of another unit is recognised: rigged assets, their rigs scaled, alone and among surroundings that
are several times as large. Usage: python -m benchmarks.rig_scale ASSETS [--names]"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.rig_scale import guess_scale
from gskin_addon.core.training.rigged import load_asset

SPLATS = 6000
FACTORS = (0.01, 0.0254, 0.1, 1.0, 10.0, 1 / 0.0254, 100.0)
OUTCOMES = ("right", "right, not sure", "nothing said", "wrong, not sure", "wrong")


def surroundings(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (M, 3) of a floor and of things on it, some three to ten times as wide as the figure."""
    low, high = np.percentile(points, [1, 99], axis=0)
    size = float(np.linalg.norm(high - low))
    wide, count = size * rng.uniform(3, 10), len(points)
    floor = np.c_[rng.normal(0, 0.35 * wide, (count, 2)), rng.normal(low[2], 0.003 * size, count)]
    middles = np.c_[rng.uniform(-0.5, 0.5, (8, 2)) * wide, np.full(8, low[2] + 0.3 * size)]
    things = (middles[:, None] + rng.normal(0, 0.15 * size, (8, count // 10, 3))).reshape(-1, 3)
    things[:, 2] = np.maximum(things[:, 2], low[2])
    around = np.concatenate([floor, things])
    around[:, :2] += (low + high)[:2] / 2
    return around


def outcome(points: np.ndarray, skeleton, factor: float) -> str:
    """What is said of a rig that was scaled by `factor`; without a unit a factor within three times is right."""
    guess = guess_scale(points, skeleton.moved(np.eye(3), factor), np.zeros(3))
    off = abs(np.log(guess.factor * factor))
    if guess.factor == 1.0:
        return "right" if factor == 1.0 else "nothing said"
    if guess.sure:
        return "right" if off < 1e-3 else "wrong"
    return "right, not sure" if off < np.log(3) and factor != 1.0 else "wrong, not sure"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("assets", type=Path)
    parser.add_argument("--names", action="store_true", help="name what is wrong")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    tables: Counter[tuple[str, float, str]] = Counter()
    wrong = []
    for entry in json.loads((options.assets / "catalog.json").read_text())["assets"]:
        try:
            asset = load_asset(options.assets / entry["npz"], SPLATS)
        except InputError:
            continue
        alone = asset.cloud.means.astype(np.float64)
        for kind, points in (("alone", alone), ("surrounded", np.concatenate([alone, surroundings(alone, rng)]))):
            for factor in FACTORS:
                found = outcome(points, asset.skeleton, factor)
                tables[kind, factor, found] += 1
                if found == "wrong":
                    wrong.append(f"{entry['name']} ({kind}, {factor:.3g})")
    print(f"| capture | rig scaled by | {' | '.join(OUTCOMES)} |\n|---|---|{'---|' * len(OUTCOMES)}")
    for kind in ("alone", "surrounded"):
        for factor in FACTORS:
            print(f"| {kind} | {factor:.4g} | {' | '.join(str(tables[kind, factor, o]) for o in OUTCOMES)} |")
    if options.names:
        print("wrong: " + ", ".join(wrong))


if __name__ == "__main__":
    main()
