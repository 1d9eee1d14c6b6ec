# SPDX-License-Identifier: GPL-3.0-or-later
"""The paper's ablations on the dev assets: initial weights, without ARAP, without coupling, 1 / 2 / 4 / 6 views.

    python -m benchmarks.ablation [--assets NAME,...] [--out out/ablation.json]

Errors are mean distances to the true posed position in % of the diagonal (see `dev_assets`), as a geometric mean
over the assets. Each view has 12 guidance images: more views are more images, and the number of iterations stays.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from benchmarks.dev_assets import DEV, GUIDANCE, MORE_VIEWS, case
from gskin_addon.core.skinning.losses import LossWeights

ROWS: dict[str, tuple[int, LossWeights | None]] = {
    "initial weights": (4, None),
    "without ARAP": (4, LossWeights(arap=0.0)),
    "without coupling": (4, LossWeights(coupling=0.0)),
    "without both": (4, LossWeights(arap=0.0, coupling=0.0)),
    **{f"{views} view{'s' if views > 1 else ''}": (views, LossWeights()) for views in MORE_VIEWS},
}
"""Name -> number of views, and losses; None learns nothing. Four views are the method as it is."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--assets", default=",".join(DEV))
    parser.add_argument("--guidance", default=",".join(GUIDANCE))
    parser.add_argument("--out", type=Path, default=Path("out/ablation.json"))
    options = parser.parse_args()
    guidance = options.guidance.split(",")
    known: dict[str, float] = json.loads(options.out.read_text()) if options.out.is_file() else {}
    print("| | " + " | ".join(f"{name}: error | relative to initial" for name in guidance) + " |")
    print("|---" * (1 + 2 * len(guidance)) + "|", flush=True)
    first: dict[str, float] = {}
    for row, (views, losses) in ROWS.items():
        cells = []
        for name in guidance:
            errors = []
            for asset in options.assets.split(","):
                key = json.dumps([row, name, asset])
                if key not in known:
                    problem = case(asset, name, views)
                    known[key] = problem.error(problem.initial if losses is None else problem.learn(losses))
                    options.out.parent.mkdir(parents=True, exist_ok=True)
                    options.out.write_text(json.dumps(known, indent=0))
                errors.append(known[key])
            mean = float(np.exp(np.log(errors).mean()))
            first.setdefault(name, mean)
            cells.append(f"{mean:.3f} | {mean / first[name]:.2f}")
        print(f"| {row} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
