# SPDX-License-Identifier: GPL-3.0-or-later
"""How close weights come to the truth: posed positions and pictures. Only this report knows the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gskin_addon.core.render.camera import Camera, evaluation_views, paper_views, percentile_bounds
from gskin_addon.core.render.image_metrics import psnr, ssim
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_cloud, skin_points
from gskin_addon.core.rig.poses import random_poses
from gskin_addon.core.rig.quaternion import axis_angle_to_matrix
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.extent import unit_frame
from gskin_addon.core.skinning.initial import initial_weights
from gskin_addon.core.splats.cloud import SplatCloud

from .skeleton import Turns

Array = NDArray[np.floating]
RANDOM_POSES = 24
PICTURED = 6
SIZE = 384


@dataclass(frozen=True)
class Score:
    """position: mean distance to the truth, in % of the object's size; psnr in dB; ssim 0..1."""

    position: float
    psnr: float
    ssim: float


def initial_of(cloud: SplatCloud, skeleton: Skeleton) -> Array:
    """The weights (N, B) that the job starts from (`--init visibility`)."""
    centre, diagonal = unit_frame(cloud.means)
    unit = replace(
        cloud,
        means=((cloud.means - centre) / diagonal).astype(np.float32),
        scales=cloud.scales / np.float32(diagonal),
    )
    bones = skeleton.moved(np.eye(3), 1.0 / diagonal, -centre / diagonal)
    cameras = paper_views(*percentile_bounds(unit.means), 512)
    masks = np.stack([render_cloud(unit, camera)[1] > 0.5 for camera in cameras])
    return initial_weights("visibility", unit, bones, masks, cameras)


def transforms_of(skeleton: Skeleton, turns: Turns) -> Array:
    """Deform transforms (B, 4, 4) of a pose given as rotation vectors in degrees."""
    vectors = np.radians([turns.get(name, (0.0, 0.0, 0.0)) for name in skeleton.names])
    angle = np.linalg.norm(vectors, axis=1)
    axis = np.where(angle[:, None] > 0, vectors / np.maximum(angle, 1e-12)[:, None], [0.0, 0.0, 1.0])
    return pose_transforms(skeleton, axis_angle_to_matrix(axis, angle))


def cameras_of(cloud: SplatCloud, size: int) -> list[Camera]:
    """The six views of an evaluation, with room for raised arms."""
    lower, upper = percentile_bounds(cloud.means)
    return evaluation_views(lower, upper, size, margin=0.12)


def score(
    cloud: SplatCloud, skeleton: Skeleton, truth: Array, candidates: dict[str, Array], seed: int = 1
) -> dict[str, Score]:
    """Scores by name over random poses (Sec. IV of the paper); pictures of the first few, one view each."""
    rng = np.random.default_rng(seed)
    cameras = cameras_of(cloud, SIZE)
    size = float(np.linalg.norm(cloud.bounds()[1] - cloud.bounds()[0]))
    total = {name: np.zeros(3) for name in candidates}
    for number in range(RANDOM_POSES):
        camera = cameras[number % len(cameras)]
        transforms = pose_transforms(skeleton, random_poses(skeleton, camera.forward, 1, rng)[0])
        right = skin_points(cloud.means, truth, transforms)
        pictured = number < PICTURED
        picture = render_cloud(skin_cloud(cloud, truth, transforms), camera)[0] if pictured else None
        for name, weights in candidates.items():
            moved = skin_points(cloud.means, weights, transforms)
            total[name][0] += 100 * np.linalg.norm(moved - right, axis=1).mean() / size / RANDOM_POSES
            if picture is not None:
                image = render_cloud(skin_cloud(cloud, weights, transforms), camera)[0]
                total[name][1:] += np.array([psnr(image, picture), ssim(image, picture)]) / PICTURED
    return {name: Score(*(float(x) for x in values)) for name, values in total.items()}


def table(scores: dict[str, Score]) -> str:
    """Initial against learned, as text."""
    first, last = scores["initial"], scores["learned"]
    change = 100 * (last.position / first.position - 1)
    rows = [
        ("against the true weights", "initial", "learned", ""),
        ("position error, % of size", f"{first.position:.3f}", f"{last.position:.3f}", f"({change:+.0f} %)"),
        ("PSNR of posed pictures, dB", f"{first.psnr:.2f}", f"{last.psnr:.2f}", f"({last.psnr - first.psnr:+.2f})"),
        ("SSIM of posed pictures", f"{first.ssim:.4f}", f"{last.ssim:.4f}", f"({last.ssim - first.ssim:+.4f})"),
    ]
    return "\n".join(f"{a:<32}{b:>10}{c:>10}   {d}".rstrip() for a, b, c, d in rows)
