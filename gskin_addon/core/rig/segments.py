# SPDX-License-Identifier: GPL-3.0-or-later
"""The line segments that a bone really spans, also where an importer invented its tail."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .skeleton import Skeleton

SHORT = 0.3
SHORT_LEAF = 0.2


@dataclass(frozen=True)
class BoneSegments:
    """starts and ends (S, 3) of the segments; bone (S,): whose each is. Every bone has at least one."""

    starts: NDArray[np.float64]
    ends: NDArray[np.float64]
    bone: NDArray[np.int64]

    def skeleton(self) -> Skeleton:
        """The segments as bones of their own, for functions that measure distances to bones."""
        names = tuple(f"{i}" for i in range(len(self.bone)))
        return Skeleton(names, np.full(len(names), -1), self.starts, self.ends)

    def nearest(self, distance: NDArray[np.float32]) -> NDArray[np.float32]:
        """Distances to the segments (N, S) as distances to the bones (N, B): the smallest of each bone."""
        out = np.full((len(distance), int(self.bone.max()) + 1), np.inf, distance.dtype)
        for column, bone in enumerate(self.bone):
            np.minimum(out[:, bone], distance[:, column], out=out[:, bone])
        return out


def bone_segments(skeleton: Skeleton) -> BoneSegments:
    """From each joint to the next, as the paper defines a bone (Sec. III-A), for any skeleton.

    glTF stores joints, not bones, so an imported bone may end anywhere, often after a hundredth of its
    limb. A bone much shorter (`SHORT`) than the way to its farthest child is replaced by segments to all of
    its children. A leaf much shorter (`SHORT_LEAF`) than its parent keeps its direction and gets the
    parent's length. All other bones are their own head and tail.
    """
    starts, ends, bones = [], [], []
    reach = np.zeros(skeleton.count)
    lengths = skeleton.lengths
    for bone in range(skeleton.count):
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        parent = int(skeleton.parents[bone])
        children = skeleton.heads[skeleton.children(bone)]
        farthest = float(np.linalg.norm(children - head, axis=1).max(initial=0.0))
        tips = tail[None]
        if lengths[bone] < SHORT * farthest:
            tips = children[np.linalg.norm(children - head, axis=1) > 1e-3 * farthest]
        elif len(children) == 0 and parent >= 0 and lengths[bone] < SHORT_LEAF * reach[parent]:
            tips = (head + (tail - head) / lengths[bone] * reach[parent])[None]
        reach[bone] = float(np.linalg.norm(tips - head, axis=1).max())
        starts += [head] * len(tips)
        ends += list(tips)
        bones += [bone] * len(tips)
    return BoneSegments(np.array(starts), np.array(ends), np.array(bones))
