# SPDX-License-Identifier: GPL-3.0-or-later
"""How good weights are: the paper's protocol (Sec. IV-C) on splats with known weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.assets import RiggedSplats
from benchmarks.metrics import POSE_SEED, held_out_poses
from gskin_addon.core.render.camera import evaluation_views
from gskin_addon.core.render.photometric import content_box, l1_dssim
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.lbs import skin_cloud, skin_points
from gskin_addon.core.splats.cloud import SplatCloud

from .lpips import Perceptual
from .protocol import Protocol

Array = NDArray[Any]

MOST_PSNR = 60.0
"""Equal pictures count as this many dB, so that means stay finite."""


@dataclass(frozen=True)
class Score:
    """error, error95: mean and 95th percentile, over splats and frames of the asset's own animation, of the distance
    to the true posed position, in % of the diagonal; random_error, random_error95: the same in random poses; psnr
    (dB), ssim, lpips (None where it was not measured): means over the pictures; l1: half the L1 distance to the true
    weights, 0..1."""

    error: float
    error95: float
    random_error: float
    random_error95: float
    psnr: float
    ssim: float
    lpips: float | None
    l1: float


class Judge:
    """Poses and true pictures of one asset, to score any number of weights against.

    frames (F, B, 4, 4): the asset's own animation, moved so that the true body stays in its place, since only the
    cameras would notice; random poses (10 % of the joints, 0.1 pi to 0.33 pi, random axes) where it has none.
    """

    def __init__(self, asset: RiggedSplats, protocol: Protocol, lpips: Perceptual | None = None) -> None:
        self._asset, self._lpips = asset, lpips
        self._points = asset.cloud.means.astype(np.float64)
        lower, upper = asset.cloud.bounds()
        self._diagonal = float(np.linalg.norm(upper - lower))
        self._poses = held_out_poses(asset.skeleton, protocol.poses, POSE_SEED)
        self._truth_poses = skin_points(self._points, asset.weights, self._poses)
        if asset.clip is None:
            self.frames = held_out_poses(asset.skeleton, protocol.frames, POSE_SEED)
        else:
            self.frames = asset.clip[_spread(len(asset.clip), protocol.frames)]
        truth = skin_points(self._points, asset.weights, self.frames)
        shift = self._points.mean(axis=0) - truth.mean(axis=1)
        self.frames = self.frames.copy()
        self.frames[:, :, :3, 3] += shift[:, None]
        self._truth = truth + shift[:, None]
        everything = self._truth.reshape(-1, 3)
        lower, upper = np.percentile(everything[:: max(1, len(everything) // 200_000)], [0.2, 99.8], axis=0)
        self.cameras = evaluation_views(lower, upper, protocol.size)[: protocol.views]
        self._rendered = _spread(len(self.frames), protocol.picture_frames)
        self._pictures = [self.render(self._true_weights(), frame) for frame in self._rendered]

    def score(self, weights: Array) -> Score:
        """The score of weights (N, B) on the asset's skeleton.

        Raises:
            ValueError: weights of another shape, or not finite.
        """
        weights = np.asarray(weights, np.float32)
        if weights.shape != self._asset.weights.shape or not np.isfinite(weights).all():
            raise ValueError(f"weights {weights.shape} do not fit {self._asset.weights.shape} or are not finite")
        return self._score(weights, weights)

    def _score(self, weights: Array, rendered: Array) -> Score:
        """Positions by weights (N, B), pictures by what `render` takes."""
        own = self.distances(weights)
        random = self._distances(weights, self._poses, self._truth_poses)
        psnr, ssim, lpips = self._compare(rendered)
        off = float(np.abs(weights - self._asset.weights).sum(axis=1).mean() / 2)
        return Score(
            float(own.mean()), float(np.percentile(own, 95)), float(random.mean()),
            float(np.percentile(random, 95)), psnr, ssim, lpips, off,
        )  # fmt: skip

    def distances(self, weights: Array) -> Array:
        """(F, N) distances to the true positions in the frames, % of the diagonal."""
        return self._distances(weights, self.frames, self._truth)

    def _distances(self, weights: Array, transforms: Array, truth: Array) -> Array:
        moved = skin_points(self._points, weights, transforms)
        moved -= truth
        return np.asarray(np.sqrt(np.einsum("fnd,fnd->fn", moved, moved)) / self._diagonal * 100)

    def render(self, weights: Array, frame: int) -> list[NDArray[np.float32]]:
        """The pictures of one frame with weights (N, B), one for each camera."""
        posed = skin_cloud(self._asset.cloud, weights, self.frames[frame], rotate_sh=False)
        return self._render(posed)

    def _render(self, posed: SplatCloud) -> list[NDArray[np.float32]]:
        return [render_cloud(posed, camera)[0] for camera in self.cameras]

    def _true_weights(self) -> Array:
        """What the true pictures are rendered with."""
        return self._asset.weights

    def _compare(self, weights: Array) -> tuple[float, float, float | None]:
        values, distances = [], []
        for frame, truths in zip(self._rendered, self._pictures, strict=True):
            for image, truth in zip(self.render(weights, int(frame)), truths, strict=True):
                values.append(compare(image, truth))
                if self._lpips is not None:
                    distances.append(self._lpips(image, truth))
        psnr, ssim = np.mean(values, axis=0)
        return float(psnr), float(ssim), float(np.mean(distances)) if distances else None


def compare(image: NDArray[np.float32], truth: NDArray[np.float32]) -> tuple[float, float]:
    """PSNR in dB, at most `MOST_PSNR`, and SSIM of two pictures (H, W, 3), over the whole picture."""
    difference = image - truth
    square = float(np.einsum("hwc,hwc->", difference, difference, dtype=np.float64)) / image.size
    psnr = MOST_PSNR if square <= 0 else min(MOST_PSNR, -10 * float(np.log10(square)))
    red, green, blue = (difference[..., channel] != 0 for channel in range(3))
    # Where the windows see no difference, SSIM is 1.
    return psnr, 1.0 - l1_dssim(image, truth, weight=1.0, box=content_box(red | green | blue))[0]


def _spread(count: int, wanted: int) -> NDArray[np.int64]:
    """At most `wanted` of the indices 0..count - 1, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(np.int64))
