# SPDX-License-Identifier: GPL-3.0-or-later
"""Random poses of Sec. IV: some joints turn about the view axis."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .quaternion import axis_angle_to_matrix
from .skeleton import Skeleton

Array = NDArray[Any]


def turnable_bones(skeleton: Skeleton) -> Array:
    """Indices of the bones that a random pose may turn.

    All but a sole root, which would only turn the whole object. With several roots (the joint they hang on
    carries no weights) each root moves a part, so it stays in.
    """
    if len(skeleton.roots) == 1 and skeleton.count > 1:
        return np.flatnonzero(skeleton.parents >= 0)
    return np.arange(skeleton.count)


def random_axes(count: int, rng: np.random.Generator) -> Array:
    """(count, 3) unit vectors, all directions alike."""
    axes = rng.normal(size=(count, 3))
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))


def random_poses(
    skeleton: Skeleton,
    axis: ArrayLike,
    count: int,
    rng: np.random.Generator,
    *,
    fraction: float = 0.1,
    angle: tuple[float, float] = (0.1 * np.pi, 0.33 * np.pi),
) -> Array:
    """`count` poses as rotations (P, B, 3, 3) in world axes for `pose_transforms`.

    Each pose turns `fraction` of the non-root bones (at least one) about `axis` (3,), or (P, 3) for one axis
    per pose, by an angle drawn from `angle` (radians) with a random sign.
    """
    bones = turnable_bones(skeleton)
    axes = np.broadcast_to(np.asarray(axis, dtype=np.float64), (count, 3))
    picked = max(1, round(fraction * len(bones)))
    rotations = np.tile(np.eye(3), (count, skeleton.count, 1, 1))
    for pose in range(count):
        chosen = rng.choice(bones, size=picked, replace=False)
        turn = rng.uniform(*angle, size=picked) * rng.choice([-1.0, 1.0], size=picked)
        rotations[pose, chosen] = axis_angle_to_matrix(np.tile(axes[pose], (picked, 1)), turn)
    return rotations
