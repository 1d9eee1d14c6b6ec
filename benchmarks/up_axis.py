# SPDX-License-Identifier: GPL-3.0-or-later
"""How often the guess of the up axis is right, wrong, or not made: rigged assets and captures, each turned to every
up axis. Usage: python -m benchmarks.up_axis ASSETS [--names] [--floor | --corner]"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections import Counter
from pathlib import Path

import numpy as np

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.axes import UP_AXES, rotate_cloud, up_rotation
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.ply import read_ply
from gskin_addon.core.splats.up_axis import guess_up
from gskin_addon.core.training.rigged import load_asset

SPLATS = 8000


def outcomes(cloud: SplatCloud) -> dict[str, str]:
    """For each up axis, what is said of a Z-up cloud that was turned to it."""
    found = {}
    for up in UP_AXES:
        guess = guess_up(rotate_cloud(cloud, up_rotation(up).T))
        found[up] = "not sure" if not guess.sure else "right" if guess.axis == up else "wrong"
    return found


def on_floor(cloud: SplatCloud, *, wall: bool) -> SplatCloud:
    """The Z-up cloud in the middle of a rough floor with as many splats, and before a wall."""
    rng = np.random.default_rng(0)
    low, high = cloud.means.min(axis=0), cloud.means.max(axis=0)
    size, middle = float((high - low).max()), (low + high) / 2
    floor = rng.uniform(-1.2, 1.2, (cloud.count, 3)) * size + middle
    floor[:, 2] = low[2] + rng.normal(0, 0.005 * size, cloud.count)
    parts = [cloud.means, floor]
    if wall:
        back = rng.uniform(-1.2, 1.2, (cloud.count // 2, 3)) * size + [*middle[:2], low[2] + 1.2 * size]
        back[:, 1] = middle[1] + 1.2 * size + rng.normal(0, 0.005 * size, len(back))
        parts.append(back)
    points = np.concatenate(parts).astype(np.float32)
    count = len(points)
    return dataclasses.replace(
        cloud,
        means=points,
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), 0.01 * size, np.float32),
        opacities=np.full(count, 0.9, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("assets", type=Path)
    parser.add_argument("--names", action="store_true", help="name what is guessed wrong")
    parser.add_argument("--floor", action="store_true", help="stand the models on a floor")
    parser.add_argument("--corner", action="store_true", help="stand them on a floor, before a wall")
    options = parser.parse_args()
    catalog = json.loads((options.assets / "catalog.json").read_text())["assets"]
    tables: dict[str, Counter[tuple[str, str]]] = {}
    wrong = []
    for entry in catalog:
        try:
            cloud = load_asset(options.assets / entry["npz"], SPLATS).cloud
        except InputError:
            continue
        if options.floor or options.corner:
            cloud = on_floor(cloud, wall=options.corner)
        for up, outcome in outcomes(cloud).items():
            tables.setdefault(entry["category"], Counter())[up, outcome] += 1
            if outcome == "wrong":
                wrong.append(f"{entry['name']} ({up})")
    print("| category | up | right | not sure | wrong |\n|---|---|---|---|---|")
    for category, table in tables.items():
        for up in UP_AXES:
            counts = " | ".join(str(table[up, outcome]) for outcome in ("right", "not sure", "wrong"))
            print(f"| {category} | {up} | {counts} |")
    for path in sorted((options.assets / "splats").glob("*.ply")):
        print(f"{path.name}: {guess_up(read_ply(path, drop_invalid=True).cloud).sentence}")
    if options.names:
        print("wrong: " + ", ".join(wrong))


if __name__ == "__main__":
    main()
