# SPDX-License-Identifier: GPL-3.0-or-later
"""The line segments that a bone really spans, also where an importer invented its tail."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .skeleton import Skeleton

SHORT, SHORT_LEAF = 0.3, 0.2
"""Share of the way to its farthest child, for a leaf of the way from its parent, below which a bone is a stub."""

POINT = 1e-9
"""Share of that way below which a leaf has no direction."""

ASIDE = 0.5
"""Cosine below which a bone does not point to a joint that hangs on it."""

FEW = 3
"""Bones with children from which on their directions, or their lengths, can be judged."""

ALIKE, AGREE, STRAIGHT = 0.02, 1 / 6, 0.999
"""How close the lengths of bones over the ways to their children are when they have one cause; share of the bones of
which this is true when all tails are wrong by one factor; cosine from which on a bone points to a child."""

LONG, OFF = 1.2, 0.25
"""Shares of the way to its farthest child: length from which on a bone set right by that factor is still too long;
distance of its end from its only child from which on a root is a handle for the whole."""


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

    def add_up(self, weights: NDArray[np.float32]) -> NDArray[np.float32]:
        """Weights of the segments (N, S) as weights of the bones (N, B): the sum of each bone."""
        out = np.zeros((len(weights), int(self.bone.max()) + 1), weights.dtype)
        for column, bone in enumerate(self.bone):
            out[:, bone] += weights[:, column]
        return out


def bone_segments(skeleton: Skeleton) -> BoneSegments:
    """From each joint to the next, as the paper defines a bone (Sec. III-A), for any skeleton.

    glTF stores joints, not bones, so imported bones may end anywhere, often after a hundredth of their limb or at a
    right angle to it (`invented_tails`). Lengths that are wrong by one factor are set right first (`tail_scale`), as
    units get lost on the way through FBX. Where most bones are stubs, each stub with children becomes segments to all
    of them; after setting lengths right, also each bone that ends beyond them, and each root that ends elsewhere than
    at its only child. Where most point aside, every bone with children does, and a leaf goes on as the way from its
    parent went, as does one without length anywhere. Elsewhere a leaf that is a stub keeps its direction and gets the
    length of that way. All other bones are their own head and tail.
    """
    starts, ends, bones = [], [], []
    scale = tail_scale(skeleton)
    if scale != 1:
        tails = skeleton.heads + (skeleton.tails - skeleton.heads) / scale
        skeleton = replace(skeleton, tails=tails)
    stubs, aside = invented_tails(skeleton)
    lengths = skeleton.lengths
    for bone in range(skeleton.count):
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        parent = int(skeleton.parents[bone])
        ways, farthest = _ways_down(skeleton, bone)
        came = head - skeleton.heads[parent] if parent >= 0 else np.zeros(3)
        way = float(np.linalg.norm(came))
        tips = tail[None]
        if farthest > 0:
            stub = stubs and lengths[bone] < SHORT * farthest
            if aside or stub or (scale != 1 and _ends_astray(ways, tail - head, parent < 0)):
                tips = head + ways
        elif way > 0 and (aside or lengths[bone] < POINT * way):
            tips = (head + came)[None]
        elif lengths[bone] < SHORT_LEAF * way:
            tips = (head + (tail - head) / lengths[bone] * way)[None]
        starts += [head] * len(tips)
        ends += list(tips)
        bones += [bone] * len(tips)
    return BoneSegments(np.array(starts), np.array(ends), np.array(bones))


def closest_on_segment(
    points: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The points (N, 3) of the segment from start to end (3,) that are closest to points (N, 3)."""
    axis = end - start
    along = np.clip((points - start) @ axis / max(float(axis @ axis), 1e-30), 0, 1)
    return np.asarray(start + along[:, None] * axis)


def segment_distance(
    points: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distances (N,) from points (N, 3) to the segment from start to end (3,)."""
    return np.asarray(np.linalg.norm(points - closest_on_segment(points, start, end), axis=1))


def tail_scale(skeleton: Skeleton) -> float:
    """The factor by which all bones are too long, below 1 where they are too short; 1 where they show none.

    Bones of most rigs end where a child begins; their lengths are then the ways to those children, or, after an
    import in other units, one and the same multiple of them.
    """
    ratios: list[NDArray[np.float64]] = []
    lengths = skeleton.lengths
    for bone in np.flatnonzero(lengths > 0):
        ways, farthest = _ways_down(skeleton, int(bone))
        if farthest == 0:
            continue
        far = np.linalg.norm(ways, axis=1)
        cosine = ways @ (skeleton.tails[bone] - skeleton.heads[bone]) / (far * lengths[bone])
        if (cosine > STRAIGHT).any():
            ratios.append(np.log(lengths[bone] / far[cosine > STRAIGHT]))
    every = np.concatenate([*ratios, np.zeros(1)])  # the last: as they should be
    agree = sum(((abs(r[:, None] - every) < ALIKE).any(axis=0) for r in ratios), np.zeros(len(every), int))
    best = int(np.argmax(agree))
    if agree[best] < max(FEW, AGREE * len(ratios)) or agree[best] <= agree[-1] or abs(every[best]) < ALIKE:
        return 1.0
    return float(np.exp(np.median(every[abs(every - every[best]) < ALIKE])))


def invented_tails(skeleton: Skeleton) -> tuple[bool, bool]:
    """Whether most bones with children are stubs, and whether most of the others point to none of their children.

    The first is a length much shorter (`SHORT`) than the way to the farthest child. A single such bone is what an
    artist made.
    """
    stubs, aside = [], []
    for bone in range(skeleton.count):
        ways, farthest = _ways_down(skeleton, bone)
        if farthest == 0:
            continue
        own = skeleton.tails[bone] - skeleton.heads[bone]
        length = float(np.linalg.norm(own))
        stubs.append(length < SHORT * farthest)
        if not stubs[-1]:
            aside.append(bool((ways @ own / (np.linalg.norm(ways, axis=1) * length)).max() < ASIDE))
    return 2 * sum(stubs) > len(stubs), len(aside) >= FEW and 2 * sum(aside) > len(aside)


def _ends_astray(ways: NDArray[np.float64], own: NDArray[np.float64], root: bool) -> bool:
    """Whether a bone, head to tail `own`, set right by the common factor, still does not tell where its flesh ends:
    beyond all children, or, for a root with one child, elsewhere than there."""
    farthest = float(np.linalg.norm(ways, axis=1).max())
    if float(np.linalg.norm(own)) > LONG * farthest:
        return True
    return root and len(ways) == 1 and float(np.linalg.norm(ways[0] - own)) > OFF * farthest


def _ways_down(skeleton: Skeleton, bone: int) -> tuple[NDArray[np.float64], float]:
    """From the bone's head to those of its children that lie elsewhere (n, 3), and the longest way, 0 without any."""
    ways = skeleton.heads[skeleton.children(bone)] - skeleton.heads[bone]
    far = np.linalg.norm(ways, axis=1)
    farthest = float(far.max(initial=0.0))
    return ways[far > 1e-3 * farthest], farthest
