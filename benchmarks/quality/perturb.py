# SPDX-License-Identifier: GPL-3.0-or-later
"""Skeletons that are not quite right, as the paper's Fig. 10 has them: redundant joints, moved joints, a missing limb.

A method sees the disturbed skeleton. Its weights are brought back to the true skeleton by `fold` and judged there,
in the true motion.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.assets import RiggedSplats
from gskin_addon.core.rig.skeleton import Skeleton

MOVED = 0.05
"""How far joints are moved, as a part of the bounding-box diagonal."""


@dataclass(frozen=True)
class Disturbed:
    """skeleton: what the method sees, B' bones; fold (B', B): weights on it, times fold, are weights on the bones of
    `asset`, which is judged; truth (N, B'): true weights on the skeleton, None where there are none."""

    asset: RiggedSplats
    skeleton: Skeleton
    fold: NDArray[np.float32]
    truth: NDArray[np.float32] | None


def own(asset: RiggedSplats) -> Disturbed:
    """Nothing disturbed."""
    return Disturbed(asset, asset.skeleton, np.eye(asset.skeleton.count, dtype=np.float32), asset.weights)


def redundant_joints(asset: RiggedSplats) -> Disturbed:
    """A joint more in the middle of every bone of the longer half: two bones where there was one.

    The halves of a bone move as one in the true motion, so any split of its weight between them is right.
    """
    skeleton = asset.skeleton
    split = skeleton.lengths >= np.median(skeleton.lengths)
    middle = (skeleton.heads + skeleton.tails) / 2
    names, parents, heads, tails, rest, origin = [], [], [], [], [], []
    last: dict[int, int] = {-1: -1}  # the new bone on which the children of an old one hang
    for bone in range(skeleton.count):
        pieces = [(skeleton.heads[bone], skeleton.tails[bone])]
        if split[bone]:
            pieces = [(skeleton.heads[bone], middle[bone]), (middle[bone], skeleton.tails[bone])]
        parent = last[int(skeleton.parents[bone])]
        for number, (head, tail) in enumerate(pieces):
            matrix = skeleton.rest[bone].copy()
            matrix[:3, 3] += head - skeleton.heads[bone]
            names.append(skeleton.names[bone] + (".half" if number else ""))
            parents.append(parent)
            heads.append(head)
            tails.append(tail)
            rest.append(matrix)
            origin.append(bone)
            parent = len(names) - 1
        last[bone] = parent
    more = Skeleton(tuple(names), np.array(parents), np.array(heads), np.array(tails), np.array(rest))
    fold = np.eye(skeleton.count, dtype=np.float32)[origin]
    return Disturbed(asset, more, fold, None)


def moved_joints(asset: RiggedSplats) -> Disturbed:
    """Every joint moved by `MOVED` of the diagonal in a direction of its own; bones that met there still meet."""
    skeleton = asset.skeleton
    lower, upper = asset.cloud.bounds()
    diagonal = float(np.linalg.norm(upper - lower))
    rng = np.random.default_rng(int(hashlib.sha1(asset.name.encode()).hexdigest()[:8], 16))
    joints = np.concatenate([skeleton.heads, skeleton.tails])
    _, place = np.unique(np.round(joints / (1e-3 * diagonal)).astype(np.int64), axis=0, return_inverse=True)
    step = rng.normal(size=(int(place.max()) + 1, 3))
    step *= MOVED * diagonal / np.linalg.norm(step, axis=1, keepdims=True)
    shift = step[place.ravel()]
    heads, tails = skeleton.heads + shift[: skeleton.count], skeleton.tails + shift[skeleton.count :]
    rest = skeleton.rest.copy()
    rest[:, :3, 3] += shift[: skeleton.count]
    other = Skeleton(skeleton.names, skeleton.parents, heads, tails, rest)
    return Disturbed(asset, other, np.eye(skeleton.count, dtype=np.float32), asset.weights)


def missing_limb(asset: RiggedSplats) -> Disturbed:
    """One limb has no bones: in truth its splats then follow the bone that it hung on.

    The limb is the branch whose share of the weight is nearest to 10 %, of at least two bones where there is one.
    """
    skeleton = asset.skeleton
    below = np.eye(skeleton.count, dtype=bool)
    for bone in reversed(range(skeleton.count)):
        if skeleton.parents[bone] >= 0:
            below[skeleton.parents[bone]] |= below[bone]
    share = asset.weights.mean(axis=0) @ below.T
    limbs = [b for b in range(skeleton.count) if skeleton.parents[b] >= 0]
    if not limbs:
        return own(asset)
    limb = min(limbs, key=lambda b: (below[b].sum() < 2, abs(share[b] - 0.1), b))
    gone, parent = below[limb], int(skeleton.parents[limb])
    kept = np.flatnonzero(~gone)
    fold = np.eye(skeleton.count, dtype=np.float32)
    fold[gone] = fold[parent]
    weights = asset.weights @ fold[:, kept]
    rest = replace(
        asset,
        skeleton=skeleton.subset(kept),
        weights=weights,
        clip=None if asset.clip is None else asset.clip[:, kept],
    )
    return Disturbed(rest, rest.skeleton, np.eye(len(kept), dtype=np.float32), weights)


DISTURBANCES: dict[str, Callable[[RiggedSplats], Disturbed]] = {
    "own": own,
    "redundant": redundant_joints,
    "moved": moved_joints,
    "missing": missing_limb,
}
"""By name."""

DISTURBANCE_TITLES = {
    "own": "own skeleton",
    "redundant": "redundant joints",
    "moved": f"joints moved by {MOVED:.0%}",
    "missing": "a limb without bones",
}
