# SPDX-License-Identifier: GPL-3.0-or-later
"""Random changes to skeletons, as other artists and tools might have made them; the weights change accordingly."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.skeleton import Skeleton

Array = NDArray[Any]
Rig = tuple[Skeleton, Array]
IDLE_NAMES = ("IK", "Control", "", "")
"""Names of idle bones, by the number of the bone that they drive; half of them have none."""


def split_bones(
    skeleton: Skeleton, weights: Array, points: Array, rng: np.random.Generator, count: int, size: float
) -> Rig:
    """Split up to `count` random bones in two, which share the weights along the bone."""
    for number in range(count):
        lengths = skeleton.lengths
        able = np.flatnonzero(lengths > 0.04 * size)
        if len(able) == 0:
            break
        bone = int(rng.choice(able))
        at = rng.uniform(0.35, 0.65)
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        middle = head + at * (tail - head)
        t = (points - head) @ (tail - head) / lengths[bone] ** 2
        ramp = rng.uniform(0.05, 0.4)
        outer = np.clip((t - at) / ramp + 0.5, 0, 1)
        outer = outer * outer * (3 - 2 * outer)
        # The new bone follows its parent; later bones move up by one.
        moved = np.where(skeleton.parents > bone, skeleton.parents + 1, skeleton.parents)
        ends = np.linalg.norm(skeleton.heads - head, axis=1) > at * lengths[bone] * 0.9
        moved = np.where((skeleton.parents == bone) & ends, bone + 1, moved)
        heads, tails = skeleton.heads.copy(), skeleton.tails.copy()
        tails[bone] = middle
        skeleton = Skeleton(
            (*skeleton.names[: bone + 1], f"{skeleton.names[bone]}+{number}", *skeleton.names[bone + 1 :]),
            np.insert(moved, bone + 1, bone),
            np.insert(heads, bone + 1, middle, axis=0),
            np.insert(tails, bone + 1, tail, axis=0),
        )
        own = weights[:, bone].copy()
        weights = np.insert(weights, bone + 1, own * outer, axis=1)
        weights[:, bone] = own * (1 - outer)
    return skeleton, weights


def drop_bones(skeleton: Skeleton, weights: Array, rng: np.random.Generator, count: int) -> Rig:
    """Remove up to `count` random bones; their weights go to their parents."""
    able = np.flatnonzero(skeleton.parents >= 0)
    if len(able) < 3:
        return skeleton, weights
    gone = rng.choice(able, min(count, len(able) // 2), replace=False)
    weights = weights.copy()
    for bone in sorted(gone, reverse=True):
        weights[:, skeleton.parents[bone]] += weights[:, bone]
    keep = np.setdiff1d(np.arange(skeleton.count), gone)
    tails = skeleton.tails.copy()
    for bone in gone:  # a bone that ended where the lost one began now ends where that one ended
        parent = int(skeleton.parents[bone])
        near = np.linalg.norm(tails[parent] - skeleton.heads[bone]) < 0.1 * skeleton.lengths[bone]
        if near and rng.random() < 0.5:
            tails[parent] = skeleton.tails[bone]
    return Skeleton(skeleton.names, skeleton.parents, skeleton.heads, tails).subset(keep), weights[:, keep]


def move_joints(skeleton: Skeleton, rng: np.random.Generator, distance: float, size: float) -> Skeleton:
    """Move each joint by up to `distance`; tails that touch a joint move with it."""
    shift = rng.normal(size=(skeleton.count, 3))
    shift *= distance * rng.random((skeleton.count, 1)) / np.linalg.norm(shift, axis=1, keepdims=True)
    free = rng.normal(size=(skeleton.count, 3))
    free *= distance * rng.random((skeleton.count, 1)) / np.linalg.norm(free, axis=1, keepdims=True)
    heads, tails = skeleton.heads + shift, skeleton.tails + free
    for bone in range(skeleton.count):
        way = np.linalg.norm(skeleton.heads - skeleton.tails[bone], axis=1)
        way[bone] = np.inf
        joint = int(way.argmin())
        if way[joint] < 0.005 * size:
            tails[bone] = skeleton.tails[bone] + shift[joint]
    return _without_zero_lengths(Skeleton(skeleton.names, skeleton.parents, heads, tails), size)


def add_idle_bones(skeleton: Skeleton, weights: Array, rng: np.random.Generator, count: int, size: float) -> Rig:
    """Add `count` bones without weights, such as IK targets, controls and helpers: near a joint, and children of a
    root, of the joint's bone or of none."""
    picked = rng.integers(0, skeleton.count, count)
    heads, tails = [], []
    for bone in picked:
        head = skeleton.tails[bone] if rng.random() < 0.5 else skeleton.heads[bone]
        away = rng.normal(size=3)
        away *= rng.uniform(0.03, 0.15) * size / np.linalg.norm(away)
        if rng.random() < 0.3:  # exactly on the bone that it drives
            head, away = skeleton.heads[bone], skeleton.tails[bone] - skeleton.heads[bone]
        heads.append(head)
        tails.append(head + away)
    parents = np.where(rng.random(count) < 0.4, -1, np.where(rng.random(count) < 0.6, skeleton.roots[0], picked))
    grown = Skeleton(
        (*skeleton.names, *(f"{IDLE_NAMES[bone % len(IDLE_NAMES)]}.{i}" for i, bone in enumerate(picked))),
        np.concatenate([skeleton.parents, parents]),
        np.concatenate([skeleton.heads, heads]),
        np.concatenate([skeleton.tails, tails]),
    )
    return _without_zero_lengths(grown, size), np.pad(weights, ((0, 0), (0, count)))


def replace_tails(skeleton: Skeleton, rng: np.random.Generator, size: float) -> Skeleton:
    """Put every tail in an arbitrary direction, at 1 % of `size`, as importers do for formats that have joints only."""
    tail = rng.normal(size=(skeleton.count, 3)) if rng.random() < 0.5 else np.tile([0.0, 0.0, 1.0], (skeleton.count, 1))
    tail = tail / np.linalg.norm(tail, axis=1, keepdims=True) * 0.01 * size
    return Skeleton(skeleton.names, skeleton.parents, skeleton.heads, skeleton.heads + tail)


def _without_zero_lengths(skeleton: Skeleton, size: float) -> Skeleton:
    """Give bones without a length a short one."""
    tails = skeleton.tails.copy()
    short = skeleton.lengths < 1e-4 * size
    tails[short] += np.array([0.0, 0.0, 0.01]) * size
    return Skeleton(skeleton.names, skeleton.parents, skeleton.heads, tails)
