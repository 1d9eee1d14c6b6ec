# SPDX-License-Identifier: GPL-3.0-or-later
"""The learned initial weights on assets of families that their model never saw, beside weights without training.

    python -m benchmarks.bench_prior --models out/prior-folds [--assets NAMES] [--splats 8000]

Each asset is judged by the shipped model if that never saw its family, else by the first model in the folder whose
metadata says so. Prints a Markdown table per category and the worst assets; errors are mean posed-position errors in %
of the diagonal.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.skinning.extent import unit_frame
from gskin_addon.core.skinning.geodesic import body_distances
from gskin_addon.core.skinning.heat import BoneHeat
from gskin_addon.core.skinning.initial import GEODESIC_SHARPNESS, falloff_weights
from gskin_addon.core.skinning.learned.model_file import SHIPPED, models_without, read_card
from gskin_addon.core.skinning.learned.predict import learned_weights

from .assets import ASSETS, RiggedSplats, load_asset
from .metrics import POSES, held_out_poses
from .quality.catalog import Entry, candidates, entry_of
from .quality.methods import create_method
from .quality.methods.base import MethodInput

SEED = 977  # the Judge's, which no training uses
BASELINES = ("visibility", "geodesic", "elastic")


class PositionJudge:
    """Posed-position error of weights of one asset, under the poses of `Judge`."""

    def __init__(self, asset: RiggedSplats) -> None:
        self._points = asset.cloud.means.astype(np.float64)
        self._poses = held_out_poses(asset.skeleton, POSES, SEED)
        lower, upper = asset.cloud.bounds()
        self._size = float(np.linalg.norm(upper - lower))
        self._truth = skin_points(self._points, asset.weights, self._poses)

    def __call__(self, weights: np.ndarray) -> np.ndarray:
        """(N,) mean error of each splat, in % of the diagonal."""
        moved = skin_points(self._points, weights, self._poses)
        return np.linalg.norm(moved - self._truth, axis=-1).mean(axis=0) / self._size * 100


def baselines(name: str, splats: int, kept: Path) -> dict[str, float]:
    """Errors of the weights that need no model, kept in a file: they never change."""
    path = kept / f"{name}.{splats}.json"
    if not path.is_file():
        asset = load_asset(name, splats)
        judge = PositionJudge(asset)
        distances = body_distances(asset.cloud, asset.skeleton)
        unit = np.square(distances / unit_frame(asset.cloud.means)[1])
        found = {
            "visibility": create_method("initial").make(MethodInput(asset, asset.skeleton, None)).weights,
            "geodesic": falloff_weights(unit, sharpness=GEODESIC_SHARPNESS),
            "elastic": BoneHeat(asset.cloud, distances).weights(),
        }
        found = {key: float(judge(weights).mean()) for key, weights in found.items()}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found))
    return json.loads(path.read_text())


def measure(entry: Entry, splats: int, models: Path, kept: Path) -> dict[str, Any] | None:
    """All errors of one asset; None where no model may judge it."""
    shipped = SHIPPED.is_file() and entry.family in read_card(SHIPPED).left_out
    model = SHIPPED if shipped else models_without(entry.family, models)
    if model is None:
        return None
    row: dict[str, Any] = asdict(entry)
    row.update(baselines(entry.name, splats, kept), model=model.name)
    asset = load_asset(entry.name, splats)
    weights, confidence = learned_weights(asset.cloud, asset.skeleton, model)
    error = PositionJudge(asset)(weights)
    wrong = 0.5 * np.abs(weights - asset.weights).sum(axis=1)
    row.update(learned=float(error.mean()), l1=float(wrong.mean()), bones=asset.skeleton.count)
    row["sure"] = float(confidence.mean())
    row["tells"] = float(np.corrcoef(1 - confidence, wrong)[0, 1]) if wrong.std() > 1e-6 else 1.0
    return row


def summary(rows: list[dict[str, Any]]) -> str:
    """A Markdown table of means per category, then the assets that fare worst."""
    lines = [
        "| category | assets | visibility | geodesic | elastic | learned | learned / visibility "
        "| worse than visibility | beats elastic |",
        "|---|" + "---|" * 8,
    ]
    for category in ("humanoid", "animal", "creature", "object", "all"):
        part = [r for r in rows if category in ("all", r["category"])]
        if not part:
            continue
        ratio = [r["learned"] / max(r["visibility"], 1e-6) for r in part]
        means = " | ".join(f"{np.mean([r[key] for r in part]):.3f}" for key in (*BASELINES, "learned"))
        worse = np.mean([x > 1 for x in ratio])
        beats = np.mean([r["learned"] < r["elastic"] for r in part])
        lines.append(f"| {category} | {len(part)} | {means} | {np.mean(ratio):.3f} | {worse:.1%} | {beats:.0%} |")
    lines.append("\nWorst by ratio: " + ", ".join(_line(r) for r in sorted(rows, key=_ratio)[::-1][:12]))
    lines.append("\nWorst by error: " + ", ".join(_line(r) for r in sorted(rows, key=lambda r: -r["learned"])[:12]))
    lines.append(f"\nMean correlation of doubt and wrong weights: {np.mean([r['tells'] for r in rows]):.2f}.")
    return "\n".join(lines)


def _ratio(row: dict[str, Any]) -> float:
    return row["learned"] / max(row["visibility"], 1e-6)


def _line(row: dict[str, Any]) -> str:
    return f"{row['name']} {row['learned']:.2f} (ratio {_ratio(row):.2f})"


def main() -> int:
    """Measure and print; returns 2 when the assets are not on this machine."""
    parser = argparse.ArgumentParser(prog="bench-prior", description=__doc__)
    parser.add_argument("--models", type=Path, default=Path("out/prior-folds"))
    parser.add_argument("--families", help="names, separated by commas (default: all)")
    parser.add_argument("--assets", help="names, separated by commas (default: all that are for evaluation)")
    parser.add_argument("--splats", type=int, default=8000)
    parser.add_argument("--out", type=Path, default=Path("out/bench-prior.json"))
    parser.add_argument("--baselines-only", action="store_true", help="make only what needs no model")
    arguments = parser.parse_args()
    if not (ASSETS / "npz").is_dir():
        print(f"'{ASSETS}' has no rigged assets; set GSKIN_ASSETS to the folder that holds npz/.", file=sys.stderr)
        return 2
    chosen = [entry_of(name) for name in arguments.assets.split(",")] if arguments.assets else candidates()
    if arguments.families:
        chosen = [e for e in chosen if e.family in arguments.families.split(",")]
    kept, rows = Path("out/prior-baselines"), []
    for entry in chosen:
        if arguments.baselines_only:
            baselines(entry.name, arguments.splats, kept)
            continue
        row = measure(entry, arguments.splats, arguments.models, kept)
        if row is not None:
            rows.append(row)
            print(f"{row['name']}: {_ratio(row):.2f} ({row['learned']:.3f})", flush=True)
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            arguments.out.write_text(json.dumps(rows, indent=1))
    if rows:
        print("\n" + summary(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
