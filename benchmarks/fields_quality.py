# SPDX-License-Identifier: GPL-3.0-or-later
"""Quality and cost of the weight fields on the same assets, with perfect and with built-in guidance.

    python -m benchmarks.fields_quality [--assets mh_008,oc_Bat] [--resolution 64] [--iterations 110]

The volume has the paper's decoder at `--resolution` (64 has half the paper's 128 along each axis). Errors as in
`dev_assets`; seconds are the core-seconds of the whole learning.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

from benchmarks.dev_assets import GUIDANCE, SCHEDULE, case


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--assets", default="mh_008,oc_Bat")
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--width", type=int, default=1024, help="channels of the decoder's first voxel")
    parser.add_argument("--iterations", type=int, default=SCHEDULE.iterations)
    parser.add_argument("--fit", action="store_true", help="also the volume that is fitted to the start")
    options = parser.parse_args()
    volume = {"resolution": options.resolution, "width": options.width}
    fields: dict[str, tuple[str, dict[str, Any]]] = {
        "pyramid": ("pyramid", {}),
        f"volume {options.resolution}": ("volume", volume),
    }
    if options.fit:
        fields[f"volume {options.resolution}, start fit"] = ("volume", {**volume, "start": "fit"})
    first = options.iterations * SCHEDULE.stages[0][1] // SCHEDULE.iterations
    (small, _), (large, _) = SCHEDULE.stages
    preset = replace(SCHEDULE, stages=((small, first), (large, options.iterations - first)))
    print(f"{options.iterations} iterations.\n")
    print("| asset | guidance | field | initial error | error | core-seconds |\n|---|---|---|---|---|---|", flush=True)
    for asset in options.assets.split(","):
        for guidance in GUIDANCE:
            problem = case(asset, guidance)
            for label, (name, settings) in fields.items():
                begun = time.process_time()
                weights = problem.learn(preset=preset, field=name, field_options=settings)
                seconds = time.process_time() - begun
                numbers = f"{problem.error(problem.initial):.3f} | {problem.error(weights):.3f} | {seconds:.1f}"
                print(f"| {asset} | {guidance} | {label} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
