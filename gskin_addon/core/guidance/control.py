# SPDX-License-Identifier: GPL-3.0-or-later
"""Control signals (Sec. III-C): random poses about the view axis, control points, dynamic mask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..render.camera import Camera
from ..rig.kinematics import pose_transforms
from ..rig.poses import random_poses
from ..rig.segments import bone_segments
from ..rig.skeleton import Skeleton

MOVED_PIXELS = 1.0


@dataclass(frozen=True)
class ControlSignal:
    """What a guidance image must show.

    view: index of the camera; camera: the camera; transforms (B, 4, 4): the pose; handles and targets (K, 2):
    the control points, pixel positions (x, y) of the displaced joints in rest and in the pose.
    """

    view: int
    camera: Camera
    transforms: NDArray[np.float64]
    handles: NDArray[np.float64]
    targets: NDArray[np.float64]


def make_signals(
    skeleton: Skeleton, cameras: list[Camera], poses_per_view: int, rng: np.random.Generator
) -> list[ControlSignal]:
    """`poses_per_view` random poses for each camera, turned about its view axis (Sec. III-C and IV)."""
    signals = []
    for view, camera in enumerate(cameras):
        rotations = random_poses(skeleton, camera.forward, poses_per_view, rng)
        for transforms in pose_transforms(skeleton, rotations):
            handles, targets = control_points(skeleton, transforms, camera)
            signals.append(ControlSignal(view, camera, transforms, handles, targets))
    return signals


def control_points(
    skeleton: Skeleton, transforms: NDArray[Any], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixel positions (K, 2) of the joints that the pose displaces: at rest (handles) and posed (targets).

    Joints are where bones begin and end (`bone_segments`, so no tail that an importer made up is one); a joint that
    two bones share counts once. Those that move by less than `MOVED_PIXELS` or stand behind the camera are left out.
    """
    segments = bone_segments(skeleton)
    rest = np.concatenate([skeleton.heads, segments.ends])
    turned = np.concatenate([transforms, transforms[segments.bone]])
    posed = np.einsum("jrc,jc->jr", turned[:, :3, :3], rest) + turned[:, :3, 3]
    handles, targets = camera.project(rest)[0], camera.project(posed)[0]
    moved = np.linalg.norm(targets - handles, axis=1) > MOVED_PIXELS  # NaN (behind the camera) is False
    pairs = np.concatenate([handles, targets], axis=1)[moved]
    _, first = np.unique(np.round(pairs, 3), axis=0, return_index=True)
    pairs = pairs[np.sort(first)]
    return pairs[:, :2], pairs[:, 2:]
