# SPDX-License-Identifier: GPL-3.0-or-later
"""The poses that weights are judged in where an asset has no animation of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.poses import random_axes, random_poses
from gskin_addon.core.rig.skeleton import Skeleton

POSES = 24

POSE_SEED = 977
"""No training and no job uses it."""


def held_out_poses(skeleton: Skeleton, count: int, seed: int) -> NDArray[np.float64]:
    """`count` random poses (P, B, 4, 4) of Sec. IV about random axes."""
    rng = np.random.default_rng(seed)
    axes = random_axes(count, rng)
    transforms: NDArray[np.float64] = pose_transforms(skeleton, random_poses(skeleton, axes, count, rng))
    return transforms
