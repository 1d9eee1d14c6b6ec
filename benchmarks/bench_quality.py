# SPDX-License-Identifier: GPL-3.0-or-later
"""`make bench-quality`: weights before and after learning, on rigged assets whose true weights are known.

Prints a Markdown table for each guidance. Needs the shared assets (or GSKIN_ASSETS).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gskin_addon.core.render.camera import paper_views, percentile_bounds
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.skinning.initial import initial_weights
from gskin_addon.core.worker.pipeline import run

from .assets import ASSETS, RiggedSplats, load_asset
from .metrics import Judge, Score

NAMED = (
    "q_animals_Cow",
    "q_animals_Fox",
    "q_animals_Horse",
    "q_single_knight_KnightCharacter",
    "qb_Animated_Human",
)
"""The five of the acceptance: two humanoids, three animals."""

MORE = (
    "q_modular_men_Suit",
    "q_platformer_game_Character",
    "od_Wizard",
    "q_easy_enemies_Spider",
    "qr_Crab",
    "qm_flying_Pigeon",
    "oc_Wipf",
)
"""Harder ones: long sleeves and capes, many legs, loose parts, facial bones."""


def initial_of(asset: RiggedSplats, name: str) -> Any:
    """The initial weights called `name`, as a job makes them."""
    cameras = paper_views(*percentile_bounds(asset.cloud.means), 512)
    masks = np.stack([render_cloud(asset.cloud, camera)[1] > 0.5 for camera in cameras])
    return initial_weights(name, asset.cloud, asset.skeleton, masks, cameras)


def measure(name: str, guidance: str, preset: str, init: str, splats: int) -> dict[str, Any]:
    """One job on one asset: scores before and after."""
    asset = load_asset(name, splats)
    judge = Judge(asset)
    before = judge.score(initial_of(asset, init))
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder) / "truth.npz"
        np.savez(truth, weights=asset.weights)
        settings = {"preset": preset, "guidance": guidance, "init": init}
        if guidance == "oracle":
            settings["options"] = {"oracle_weights": str(truth)}
        started = time.monotonic()
        outcome = run(asset.cloud, asset.skeleton, settings, lambda *_: None, Path(folder))
        seconds = time.monotonic() - started
    after = judge.score(outcome.weights)
    return {
        "asset": name,
        "guidance": guidance,
        "preset": preset,
        "init": init,
        "splats": splats,
        "bones": asset.skeleton.count,
        "before": asdict(before),
        "after": asdict(after),
        "seconds": round(seconds, 1),
    }


def row(result: dict[str, Any]) -> str:
    """A line of the table."""
    before, after = Score(**result["before"]), Score(**result["after"])
    return (
        f"| {result['asset']} | {result['bones']} | {before.error:.3f} | {after.error:.3f} "
        f"| {after.error / before.error:.2f} | {before.error95:.2f} | {after.error95:.2f} "
        f"| {before.psnr:.2f} | {after.psnr:.2f} | {after.psnr - before.psnr:+.2f} "
        f"| {before.ssim:.4f} | {after.ssim:.4f} | {result['seconds']:.0f} |"
    )


HEADER = (
    "| asset | bones | error before | after | ratio | 95 % before | after | PSNR before | after | gain "
    "| SSIM before | after | seconds |\n|---|" + "---|" * 12
)


def main() -> int:
    """Measure and print; returns 2 when the assets are not on this machine."""
    parser = argparse.ArgumentParser(prog="bench-quality", description=__doc__)
    parser.add_argument("--assets", default=",".join(NAMED + MORE), help="names, separated by commas")
    parser.add_argument("--guidance", default="oracle,elastic", help="names, separated by commas")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--init", default="visibility")
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--out", type=Path, default=Path("out/bench-quality.json"))
    arguments = parser.parse_args()
    if not (ASSETS / "npz").is_dir():
        print(f"'{ASSETS}' has no rigged assets; set GSKIN_ASSETS to the folder that holds npz/.", file=sys.stderr)
        return 2
    results = []
    for guidance in arguments.guidance.split(","):
        print(f"\nGuidance `{guidance}`, preset `{arguments.preset}`, initial weights `{arguments.init}`, ", end="")
        print(f"{arguments.splats} splats; errors in % of the diagonal.\n\n{HEADER}", flush=True)
        for name in arguments.assets.split(","):
            results.append(measure(name, guidance, arguments.preset, arguments.init, arguments.splats))
            print(row(results[-1]), flush=True)
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            arguments.out.write_text(json.dumps(results, indent=1))
        ratios = [r["after"]["error"] / r["before"]["error"] for r in results if r["guidance"] == guidance]
        print(f"\nMean ratio {np.mean(ratios):.2f}, largest {max(ratios):.2f}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
