# SPDX-License-Identifier: GPL-3.0-or-later
"""Bendy bones: a bone of n segments moves its splats by n + 1 joints, two of them at a time. numpy only.

As Blender's Armature modifier has it: how far a point at rest lies along the bone says between which two joints it is
and how much each counts. So inside a bone the weights have a gradient, which belongs to the local map.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .quaternion import normalize
from .stretch import RIGID, polar, size, unevenness

Array = NDArray[Any]


@dataclasses.dataclass(frozen=True, eq=False)
class BendyBone:
    """A bone of n segments in a pose.

    joints:  (n + 1, 4, 4) deform transforms (world) of the joints between segments, head and tail among them.
    to_bone: (4, 4) from the world to the bone's space at rest, in which it lies along y from 0 to `length`.
    """

    joints: Array
    to_bone: Array
    length: float

    @property
    def segments(self) -> int:
        """Number of segments n."""
        return len(self.joints) - 1

    def place(self, points: Array) -> tuple[Array, Array, Array]:
        """First joint (N,), share of the next one (N,) and its gradient (N, 3) for points (N, 3) at rest, world."""
        along = points @ self.to_bone[1, :3] + self.to_bone[1, 3]
        along = along / self.length * self.segments
        first = np.clip(np.floor(along), 0, self.segments - 1).astype(int)
        share = np.clip(along - first, 0, 1)
        inside = (along > 0) & (along < self.segments)
        return first, share, inside[:, None] * self.to_bone[1, :3] * (self.segments / self.length)

    def is_bent(self, transform: Array) -> bool:
        """Whether the joints do anything else than the bone's own deform transform (4, 4) does."""
        difference = self.joints - transform
        middle = np.linalg.inv(self.to_bone)[:3, 3]
        moved = difference[:, :3, :3] @ middle + difference[:, :3, 3]
        turned = np.linalg.norm(difference[:, :3, :3], axis=(1, 2))
        length = self.length * np.linalg.norm(np.linalg.inv(self.to_bone)[:3, 1])
        return bool(turned.max() > RIGID or np.linalg.norm(moved, axis=1).max() > RIGID * length)

    def deform(self, points: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Points (N, 3) moved, (N, 3), and the map around each, (N, 3, 3); turn, unevenness and size of the map.

        Turn, unit (N, 4), and `stretch.size` (N,) are those of the joints; the unevenness (N,) counts the bend, too.
        """
        first, share, gradient = self.place(points)
        low, high = self.joints[first], self.joints[first + 1]
        ends = [m[:, :3, :3] @ points[:, :, None] + m[:, :3, 3:] for m in (low, high)]
        moved = (1 - share[:, None]) * ends[0][:, :, 0] + share[:, None] * ends[1][:, :, 0]
        part = share[:, None, None]
        maps = (1 - part) * low[:, :3, :3] + part * high[:, :3, :3] + (ends[1] - ends[0]) @ gradient[:, None, :]
        linear = self.joints[:, :3, :3]
        quats, uneven, sizes = polar(linear)[0], unevenness(linear)[1], size(linear)
        bend = np.linalg.norm(np.diff(linear, axis=0), axis=(1, 2))
        uneven = np.maximum(np.maximum(uneven[first], uneven[first + 1]), bend[first])
        turns = _between(quats[first], quats[first + 1], share)
        return moved, maps, turns, uneven, (1 - share) * sizes[first] + share * sizes[first + 1]


def _between(a: Array, b: Array, share: Array) -> Array:
    sign = np.where(np.einsum("nk,nk->n", a, b) < 0, -1.0, 1.0)
    return normalize((1 - share[:, None]) * a + (share * sign)[:, None] * b)
