# SPDX-License-Identifier: GPL-3.0-or-later
"""Which loss weights are best: every setting on the dev assets, with perfect and with built-in guidance.

    python -m benchmarks.sweep_losses [--only NAME,...] [--out out/sweep.json]

One setting at a time is changed from `BASE`, then the best ones together. Prints for each setting the
error relative to that of the initial weights, as a geometric mean over the assets, and the worst asset. About
half a minute for each setting on one core. Results are kept in --out, so that a stopped sweep goes on.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.dev_assets import DEV, GUIDANCE, SCHEDULE, Case, case
from gskin_addon.core.skinning.fields.pyramid import SparsePyramid
from gskin_addon.core.skinning.losses import LossWeights
from gskin_addon.core.skinning.optimise import LearningOptions, Optimiser

BASE: dict[str, Any] = {"arap": 0.02, "coupling": 20.0, "anchor": 0.0, "arap_neighbours": 30}
"""Where the sweep began; what is not here is as in `LossWeights`."""

TOGETHER: dict[str, Any] = {"arap_neighbours": 10, "coupling": 10.0, "anchor": 0.0001}

SETTINGS: dict[str, dict[str, Any]] = {
    "base": {},
    "arap=0": {"arap": 0.0},
    "arap=0.005": {"arap": 0.005},
    "arap=0.08": {"arap": 0.08},
    "arap=0.3": {"arap": 0.3},
    "coupling=0": {"coupling": 0.0},
    "coupling=2": {"coupling": 2.0},
    "coupling=100": {"coupling": 100.0},
    "K1=10": {"arap_neighbours": 10},
    "K1=6": {"arap_neighbours": 6},
    "K2=30": {"coupling_neighbours": 30},
    "all nodes": {"arap_nodes": 0},
    "dssim=0.5": {"dssim": 0.5},
    "anchor=0.00003": {"anchor": 0.00003},
    "anchor=0.0001": {"anchor": 0.0001},
    "anchor=0.0003": {"anchor": 0.0003},
    "anchor=0.001": {"anchor": 0.001},
    "anchor=0.003": {"anchor": 0.003},
    "rate 0.05": {"rate": 0.05},
    "rate 0.2": {"rate": 0.2},
    "K1=10 arap=0.04": {"arap_neighbours": 10, "arap": 0.04},
    "K1=10 coupling=5": {"arap_neighbours": 10, "coupling": 5.0},
    "K1=10 coupling=5 anchor=0.0001": {**TOGETHER, "coupling": 5.0},
    "K1=10 coupling=10 anchor=0.0001": TOGETHER,
    "K1=10 coupling=10 anchor=0.0003": {**TOGETHER, "anchor": 0.0003},
    "K1=10 coupling=10 anchor=0.0001 rate=0.05": {**TOGETHER, "rate": 0.05},
}
"""Names and what is changed: options of LossWeights; `rate`: Adam's."""


def learned(problem: Case, change: dict[str, Any]) -> float:
    """The error after learning with a setting."""
    options = {**BASE, **change}
    rate = options.pop("rate", SCHEDULE.learning_rate)
    preset = replace(SCHEDULE, learning_rate=rate)
    optimiser = Optimiser(
        problem.cloud,
        problem.skeleton,
        SparsePyramid(problem.cloud.means, problem.initial),
        problem.targets,
        preset,
        options=LearningOptions(losses=replace(LossWeights(), **options)),
    )
    for _ in range(preset.iterations):
        optimiser.step()
    return problem.error(optimiser.weights())


def line(name: str, ratios: dict[str, list[float]]) -> str:
    """A row of the table: geometric mean and worst ratio for each guidance."""
    cells = [f"{np.exp(np.log(r).mean()):.3f} | {max(r):.2f}" for r in ratios.values()]
    return f"| {name} | " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default=",".join(SETTINGS), help="names of settings, separated by commas")
    parser.add_argument("--assets", default=",".join(DEV))
    parser.add_argument("--set", action="append", default=[], metavar="NAME=JSON", help="a further setting")
    parser.add_argument("--out", type=Path, default=Path("out/sweep_losses.json"))
    options = parser.parse_args()
    settings = {name: SETTINGS[name] for name in options.only.split(",") if name}
    settings.update({name: json.loads(text) for name, _, text in (pair.partition("=") for pair in options.set)})
    known: dict[str, float] = json.loads(options.out.read_text()) if options.out.is_file() else {}
    print("| setting | " + " | ".join(f"{g}: error / initial | worst" for g in GUIDANCE) + " |")
    print("|---" * (1 + 2 * len(GUIDANCE)) + "|", flush=True)
    for name, change in settings.items():
        ratios: dict[str, list[float]] = {}
        for guidance in GUIDANCE:
            for asset in options.assets.split(","):
                key = json.dumps([guidance, asset, {**BASE, **change}], sort_keys=True)
                if key not in known:
                    problem = case(asset, guidance)
                    known[key] = learned(problem, change) / problem.error(problem.initial)
                    options.out.parent.mkdir(parents=True, exist_ok=True)
                    options.out.write_text(json.dumps(known, indent=0))
                ratios.setdefault(guidance, []).append(known[key])
        print(line(name, ratios), flush=True)


if __name__ == "__main__":
    main()
