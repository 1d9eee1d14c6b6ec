# SPDX-License-Identifier: GPL-3.0-or-later
"""The preset `paper` against `thorough` with perfect guidance images, asset by asset.

    python -m benchmarks.paper_preset [--assets NAME,...] [--splats 20000] [--size 512] [--iterations 500] [--batch 20]

Without options both run as a user has them. On a CPU the weight volume takes hours for it, so all sizes can be
reduced, for both alike. The default assets are of OpenDungeons, a family that the shipped learned weights have not
seen. Rows between the two change one thing at a time, to tell where a difference comes from. Errors are mean distances
to the true posed position in % of the diagonal, over 24 random poses that no job has seen, with all bones and with the
four strongest. A finished row is kept in `--out` and not run again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.assets import RiggedSplats, load_asset
from benchmarks.metrics import POSE_SEED, POSES, held_out_poses
from gskin_addon.core.pipeline.run import run
from gskin_addon.core.rig.lbs import skin_points, sparsify
from gskin_addon.core.skinning import presets

ASSETS = ("od_Dwarf1", "od_LavaSpawn", "od_Orc", "od_Goblin", "od_Wyvern")
AS_PYRAMID = {"field": "pyramid"}
OUR_LOSSES = {"anchor": 0.0001, "arap_neighbours": 10, "arap_nodes": 2000}
ROWS: dict[str, dict[str, Any]] = {
    "initial weights (Eq. 6-7)": {"guidance": "none", "init": "visibility", "max_influences": 0},
    "paper": {"preset": "paper"},
    "paper, with the pyramid": {"preset": "paper", **AS_PYRAMID},
    "paper, with the pyramid, our losses": {"preset": "paper", **AS_PYRAMID, "losses": OUR_LOSSES},
    "thorough, from Eq. 6-7": {"preset": "thorough", "init": "visibility"},
    "thorough": {"preset": "thorough"},
}
"""Name -> settings of the job, beside the guidance."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", default=",".join(ASSETS))
    parser.add_argument("--rows", default=";".join(ROWS), help="separated by semicolons")
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=512, help="of the renders, pixels")
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--batch", type=int, default=20)
    parser.add_argument("--poses", type=int, default=50, help="guidance images of each view")
    parser.add_argument("--fit-steps", type=int, default=500)
    parser.add_argument("--width", type=int, default=1024, help="channels of the decoder's first voxel")
    parser.add_argument("--out", type=Path, default=Path("out/paper_preset.json"))
    options = parser.parse_args()
    smaller = {"stages": ((options.size, options.iterations),), "batch": options.batch, "poses_per_view": options.poses}
    for name in ("paper", "thorough"):
        presets.PRESETS[name] = replace(presets.PRESETS[name], **smaller)
    scale = [options.splats, options.size, options.iterations, options.batch, options.poses]
    volume = {"fit_steps": options.fit_steps, "width": options.width}
    scale += list(volume.values())
    known: dict[str, Any] = json.loads(options.out.read_text()) if options.out.is_file() else {}
    print("| asset | row | error | of 4 bones | iterations | core-seconds |\n" + "|---" * 6 + "|", flush=True)
    for name in options.assets.split(","):
        asset = load_asset(name, options.splats)
        for row in options.rows.split(";"):
            key = json.dumps([name, row, *scale])
            if key not in known:
                known[key] = measure(asset, ROWS[row], volume)
                options.out.parent.mkdir(parents=True, exist_ok=True)
                options.out.write_text(json.dumps(known, indent=0))
            found = known[key]
            errors = f"{found['error']:.3f} | {found['error_of_four']:.3f}"
            print(f"| {name} | {row} | {errors} | {found['iterations']} | {found['seconds']:.0f} |", flush=True)


def measure(asset: RiggedSplats, row: dict[str, Any], volume: dict[str, int]) -> dict[str, Any]:
    """Error and cost of a job on an asset; volume: options of the weight volume, where the row has one."""
    settings: dict[str, Any] = {"guidance": "oracle", "rasterizer": "cpu", **row}
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        if settings["guidance"] == "oracle":
            truth = Path(folder) / "truth.npz"
            np.savez(truth, weights=asset.weights)
            settings["options"] = {"oracle_weights": str(truth)}
            if "field" not in row and row["preset"] == "paper":
                settings["field_options"] = volume
        checkpoint = Path(folder) / "checkpoint"
        checkpoint.mkdir()
        outcome = run(asset.cloud, asset.skeleton, settings, lambda *_: None, checkpoint)
    spent = time.process_time() - begun
    points = asset.cloud.means.astype(np.float64)
    poses = held_out_poses(asset.skeleton, POSES, POSE_SEED)
    truth_points = skin_points(points, asset.weights, poses)
    lower, upper = asset.cloud.bounds()

    def error(weights: NDArray[np.float32]) -> float:
        off = skin_points(points, weights, poses) - truth_points
        return float(np.linalg.norm(off, axis=-1).mean() / np.linalg.norm(upper - lower) * 100)

    told = outcome.report
    return {
        "error": error(outcome.weights),
        "error_of_four": error(sparsify(outcome.weights, 4)),
        "iterations": told.get("iterations", 0),
        "seconds": spent,
        "fit": told.get("fit", {}),
    }


if __name__ == "__main__":
    main()
