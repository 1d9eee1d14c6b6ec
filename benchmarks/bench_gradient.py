# SPDX-License-Identifier: GPL-3.0-or-later
"""Would splats follow a bent body better by the gradient of the blended map than by Eq. 3? Measured at the joints.

The weights change across a splat, so the map x -> sum_b w_b(x) P_b x has the derivative J = sum_b w_b A_b +
sum_b (P_b x) grad w_b^T. The gradients are fitted to the weights of the nearest splats. Truth are pictures of the posed
mesh, densely covered; PSNR is taken where splats of several bones are seen.
Usage: python -m benchmarks.bench_gradient [ASSETS]"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.assets import ASSETS, RiggedSplats, load_asset
from benchmarks.metrics import POSE_SEED, held_out_poses
from benchmarks.quality.catalog import balanced, candidates
from gskin_addon.core.render.camera import evaluation_views
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.covariance import transform_gaussians
from gskin_addon.core.rig.lbs import skin_cloud, skin_points, sparsify
from gskin_addon.core.splats.cloud import SH_C0, SplatCloud
from gskin_addon.core.splats.from_mesh import sample_mesh
from gskin_addon.core.training.rigged import read_rigged_mesh

Array = NDArray[Any]

SPLATS = 20_000
DENSE = 150_000
POSES = 4
SIZE = 256
NEIGHBOURS = 16
RIDGE = 0.05
"""Of the least squares, relative to the spread of the neighbours: off the surface weights have no gradient to fit."""
BLENDED = 0.9
"""Splats whose strongest weight is below it are at a joint."""
CLIPS = {"J": (0.0, np.inf), "J clipped to 0.5..2": (0.5, 2.0), "J never smaller": (1.0, 2.0)}


def local_maps(points: Array, weights: Array, poses: Array) -> Array:
    """J (P, N, 3, 3) for points (N, 3), weights (N, B), deform transforms (P, B, 4, 4)."""
    distance, near = cKDTree(points).query(points, NEIGHBOURS + 1)
    near, distance = near[:, 1:], distance[:, 1:]
    offset = points[near] - points[:, None]
    reach = distance.mean(axis=1)
    kernel = np.exp(-((distance / reach[:, None]) ** 2))
    normal = np.einsum("nk,nki,nkj->nij", kernel, offset, offset)
    normal += (RIDGE / 3 * reach**2 * kernel.sum(axis=1))[:, None, None] * np.eye(3)
    inverse = np.linalg.inv(normal)
    found = []
    for pose in poses:
        blended = (weights @ pose[:, :3, :].reshape(len(pose), 12)).reshape(-1, 3, 4)
        change = blended[near] - blended[:, None]
        moved = np.einsum("nkij,nj->nki", change[..., :3], points) + change[..., 3]
        slope = np.einsum("nk,nki,nkj->nij", kernel, moved, offset) @ inverse
        found.append(blended[:, :, :3] + slope)
    return np.stack(found)


def score(asset: RiggedSplats, folder: Any = ASSETS) -> dict[str, float] | None:
    """Mean PSNR at the joints by method; None where no splat has several bones."""
    weights = sparsify(asset.weights, 4).astype(np.float64)
    blended = weights.max(axis=1) < BLENDED
    if blended.mean() < 0.01:
        return None
    mesh = read_rigged_mesh(folder / "npz" / f"{asset.name}.npz")
    held = mesh.weights[:, [mesh.skeleton.names.index(name) for name in asset.skeleton.names]]
    held = held / np.maximum(held.sum(axis=1, keepdims=True), 1e-12)
    poses = held_out_poses(asset.skeleton, POSES, POSE_SEED)
    points = asset.cloud.means.astype(np.float64)
    values: dict[str, list[float]] = {}
    for pose, maps in zip(poses, local_maps(points, weights, poses), strict=True):
        verts = skin_points(mesh.verts, held, pose)
        rng = np.random.default_rng(0)
        truth, _, _ = sample_mesh(
            verts, mesh.faces, mesh.corner_rgb, DENSE, rng, below=0, scatter=0, flatness=0.1
        )
        truth = dataclasses.replace(truth, opacities=np.full(truth.count, 0.99, np.float32))
        usual = skin_cloud(asset.cloud, weights, pose)
        clouds = {"Eq. 3": usual}
        u, stretch, vt = np.linalg.svd(maps)
        for name, limits in CLIPS.items():
            shape = transform_gaussians(
                asset.cloud.quats, asset.cloud.scales, (u * np.clip(stretch, *limits)[:, None, :]) @ vt
            )
            clouds[name] = dataclasses.replace(usual, quats=shape[0], scales=shape[1])
        for camera in evaluation_views(verts.min(axis=0), verts.max(axis=0), SIZE)[:4:2]:
            seen = render_cloud(_marked(usual, blended), camera, background=(0.0, 0.0, 0.0))[0][..., 0] > 0.5
            if seen.any():
                picture = render_cloud(truth, camera)[0]
                for name, cloud in clouds.items():
                    square = float(((render_cloud(cloud, camera)[0] - picture)[seen] ** 2).mean())
                    values.setdefault(name, []).append(-10 * np.log10(max(square, 1e-6)))
    return {name: float(np.mean(each)) for name, each in values.items()}


def _marked(cloud: SplatCloud, mask: Array) -> SplatCloud:
    """White where the mask is set, else black."""
    color = (mask[:, None] * np.ones(3) - 0.5) / SH_C0
    return dataclasses.replace(cloud, sh=color[:, None, :].astype(np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("assets", nargs="*", help="names; default: 24 of the benchmark's, balanced")
    parser.add_argument("--count", type=int, default=24)
    options = parser.parse_args()
    names = options.assets or [entry.name for entry in balanced(candidates(), 3 * options.count)]
    found: list[dict[str, float]] = []
    for name in names:
        scores = score(load_asset(name, SPLATS))
        if scores is not None:
            found.append(scores)
            print(name, ", ".join(f"{method} {value:.2f}" for method, value in scores.items()), flush=True)
        if len(found) == options.count:
            break
    for method in found[0]:
        gains = np.array([scores[method] - scores["Eq. 3"] for scores in found])
        mean = np.mean([scores[method] for scores in found])
        better, worse = int((gains > 0.02).sum()), int((gains < -0.02).sum())
        print(f"{method}: {mean:.2f} dB, {gains.mean():+.3f} against Eq. 3; better on {better}, worse on {worse}")


if __name__ == "__main__":
    main()
