# SPDX-License-Identifier: GPL-3.0-or-later
"""How good weights are: the paper's protocol (Sec. IV-C) on splats with known weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gskin_addon.core.render.camera import evaluation_views, percentile_bounds
from gskin_addon.core.render.image_metrics import psnr
from gskin_addon.core.render.photometric import l1_dssim
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_cloud, skin_points
from gskin_addon.core.rig.poses import random_poses
from gskin_addon.core.rig.skeleton import Skeleton

from .assets import RiggedSplats

POSES, SIZE = 24, 512


@dataclass(frozen=True)
class Score:
    """error, error95: mean and 95th-percentile distance to the true posed position, % of the diagonal;
    psnr (dB) and ssim: means over all renders; weights: half the L1 distance to the true weights."""

    error: float
    error95: float
    psnr: float
    ssim: float
    weights: float


class Judge:
    """Poses and true pictures of one asset, to score any number of weights against.

    24 random poses (10 % of the joints, 0.1 pi to 0.33 pi, random axes), drawn from a seed that no training
    uses, x the six evaluation views at 512 px.
    """

    def __init__(self, asset: RiggedSplats, *, poses: int = POSES, size: int = SIZE, seed: int = 977) -> None:
        self._asset = asset
        self._poses = held_out_poses(asset.skeleton, poses, seed)
        self._cameras = evaluation_views(*percentile_bounds(asset.cloud.means), size)
        lower, upper = asset.cloud.bounds()
        self._diagonal = float(np.linalg.norm(upper - lower))
        self._points = asset.cloud.means.astype(np.float64)
        self._truth = skin_points(self._points, asset.weights, self._poses)
        self._pictures = [self._render(asset.weights, pose) for pose in self._poses]

    def score(self, weights: NDArray[np.floating]) -> Score:
        """The score of weights (N, B)."""
        moved = skin_points(self._points, weights, self._poses)
        distance = np.linalg.norm(moved - self._truth, axis=-1) / self._diagonal * 100
        values = [
            (min(psnr(image, truth), 60.0), 1.0 - l1_dssim(image, truth, weight=1.0)[0])
            for pose, pictures in zip(self._poses, self._pictures, strict=True)
            for image, truth in zip(self._render(weights, pose), pictures, strict=True)
        ]
        mean = np.mean(values, axis=0)
        off = float(np.abs(weights - self._asset.weights).sum(axis=1).mean() / 2)
        return Score(
            float(distance.mean()), float(np.percentile(distance, 95)), float(mean[0]), float(mean[1]), off
        )

    def _render(
        self, weights: NDArray[np.floating], transforms: NDArray[np.float64]
    ) -> list[NDArray[np.float32]]:
        posed = skin_cloud(self._asset.cloud, weights, transforms, rotate_sh=False)
        return [render_cloud(posed, camera)[0] for camera in self._cameras]


def held_out_poses(skeleton: Skeleton, count: int, seed: int) -> NDArray[np.float64]:
    """`count` random poses (P, B, 4, 4) of Sec. IV about random axes."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    transforms: NDArray[np.float64] = pose_transforms(skeleton, random_poses(skeleton, axes, count, rng))
    return transforms
