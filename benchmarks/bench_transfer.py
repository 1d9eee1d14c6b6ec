# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights transferred from a mesh and from other splats, against the truth: aligned, shifted, scaled; and the times.

    python -m benchmarks.bench_transfer ASSETS [--splats N] [--time N]

ASSETS: folder with npz/, as of `core/training/rigged.py`. For each way three numbers. L1: mean over the splats of the
summed differences of weights, 0 to 2. Posed error: mean distance in random poses (Sec. IV of the paper), in thousandths
of the body's diagonal. Astray: splats in ten thousand whose strongest bone is far in the skeleton from the true one, as
a thigh is from a hand.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.metrics import POSE_SEED, held_out_poses
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.skinning.edits.separate import FAR, steps_between
from gskin_addon.core.skinning.transfer.transfer import Shape, transfer
from gskin_addon.core.training.rigged import RiggedMesh, RiggedSplats, load_asset, read_rigged_mesh

NAMES = ("mh_000", "mh_012", "godette_vrm", "ani_cat", "ani_horse", "luanti_spider", "boxman", "od_Chicken")
OFF = 0.02
"""Shift, as a share of the diagonal, and growth of the source in the hard cases."""
POSES = 8
WAYS = {"nearest": {"inpaint": False}, "inpainted": {}, "fitted first": {"fit": True}}

Array = NDArray[Any]


@dataclass(frozen=True)
class Asset:
    """Splats with the truth, another sampling of the same body, and the mesh with the weights of the same bones."""

    splats: RiggedSplats
    other: RiggedSplats
    mesh: RiggedMesh
    weights: Array

    @classmethod
    def load(cls, path: Path, count: int) -> Asset:
        """`count` splats each, as `benchmarks/quality/protocol.py` has them."""
        one, two = (load_asset(path, count, seed) for seed in (0, 1))
        mesh = read_rigged_mesh(path)
        order = [mesh.skeleton.names.index(name) for name in one.skeleton.names]
        return cls(one, two, mesh, mesh.weights[:, order])


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", type=Path)
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--time", type=int, default=150_000, help="splats of the timed run; 0 for none")
    options = parser.parse_args()
    errors: dict[tuple[str, str, str], list[tuple[float, ...]]] = {}
    for name in NAMES:
        asset = Asset.load(options.assets / "npz" / f"{name}.npz", options.splats)
        for key, value in judge(asset).items():
            errors.setdefault(key, []).append(value)
        print(f"{name}: done", flush=True)
    print(f"\n| source | where | {' | '.join(WAYS)} |\n|---|---|{'---|' * len(WAYS)}")
    for source, where in dict.fromkeys(key[:2] for key in errors):
        means = [np.mean(errors[source, where, way], axis=0) for way in WAYS]
        cells = (f"{weight:.3f}, {posed:.2f}, {astray:.0f}" for weight, posed, astray in means)
        print(f"| {source} | {where} | {' | '.join(cells)} |")
    if options.time:
        measure(Asset.load(options.assets / "npz" / f"{NAMES[0]}.npz", options.time))


def judge(asset: Asset) -> dict[tuple[str, str, str], tuple[float, ...]]:
    """L1, posed error and how many are astray by source, where it lies, and way."""
    cloud, truth = asset.splats.cloud, asset.splats.weights
    verts = asset.mesh.verts
    diagonal, middle = float(np.linalg.norm(np.ptp(verts, axis=0))), verts.mean(axis=0)
    way = np.random.default_rng(5).normal(size=3)
    shift = OFF * diagonal * way / np.linalg.norm(way)
    places: dict[str, Callable[[Array], Array]] = {
        "in place": lambda points: points,
        f"{OFF:.0%} aside": lambda points: points + shift,
        f"{OFF:.0%} larger": lambda points: (points - middle) * (1 + OFF) + middle,
    }
    far = steps_between(asset.splats.skeleton.parents) >= FAR
    poses = held_out_poses(asset.splats.skeleton, POSES, POSE_SEED)
    means = cloud.means.astype(np.float64)
    right = skin_points(means, truth.astype(np.float64), poses)
    target, other = Shape.of_splats(cloud), Shape.of_splats(asset.other.cloud)
    found = {}
    for where, moved in places.items():
        sources = {
            "mesh": (Shape.of_mesh(moved(verts), asset.mesh.faces), asset.weights),
            "splats": (replace(other, points=moved(other.points)), asset.other.weights),
        }
        for source, (shape, weights) in sources.items():
            for name, how in WAYS.items():
                result = transfer(shape, weights, target, **how).weights
                posed = skin_points(means, result.astype(np.float64), poses)
                error = 1000 * float(np.linalg.norm(posed - right, axis=-1).mean()) / diagonal
                astray = 1e4 * float(far[truth.argmax(axis=1), result.argmax(axis=1)].mean())
                found[source, where, name] = float(np.abs(result - truth).sum(axis=1).mean()), error, astray
    return found


def measure(asset: Asset) -> None:
    """Print the processor time of each part on a large cloud."""
    print(f"\n{asset.splats.cloud.count:,} splats, {len(asset.mesh.faces):,} triangles, {asset.weights.shape[1]} bones")
    diagonal = float(np.linalg.norm(np.ptp(asset.mesh.verts, axis=0)))

    def timed(label: str, work: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = work()
        print(f"{label}: {time.process_time() - start:.1f} s of processor time", flush=True)
        return result

    splats = timed("shape of the splats", lambda: Shape.of_splats(asset.splats.cloud))
    mesh = timed("shape of the mesh", lambda: Shape.of_mesh(asset.mesh.verts, asset.mesh.faces))
    other = Shape.of_splats(asset.other.cloud)
    aside = Shape.of_mesh(asset.mesh.verts + [OFF * diagonal, 0, 0], asset.mesh.faces)
    timed("mesh to splats", lambda: transfer(mesh, asset.weights, splats))
    timed(f"mesh {OFF:.0%} aside to splats", lambda: transfer(aside, asset.weights, splats))
    timed("the same, fitted first", lambda: transfer(aside, asset.weights, splats, fit=True))
    timed("splats to splats", lambda: transfer(other, asset.other.weights, splats))
    timed("splats to mesh", lambda: transfer(splats, asset.splats.weights, mesh))


if __name__ == "__main__":
    main()
