# SPDX-License-Identifier: GPL-3.0-or-later
"""What the bone tree alone says: kinship of pairs, and numbers of each bone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.skeleton import Skeleton

Array = NDArray[Any]

RELATIONS = (
    "self", "parent", "child", "sibling", "grandparent", "grandchild", "ancestor", "descendant",
    "uncle", "nephew", "cousin", "distant",
)  # fmt: skip
"""What bone b can be to bone a."""

BONE_FEATURES = (
    "length", "depth", "height", "children", "leaf", "root", "subtree", "turn", "parent length", "twin",
    "gap to parent", "siblings",
)  # fmt: skip


def ancestry(parents: Array) -> Array:
    """(B, B) int: steps from bone a up to bone b, 0 for itself, -1 where b is no ancestor of a."""
    count = len(parents)
    up = np.full((count, count), -1, np.int64)
    for bone, parent in enumerate(parents):  # parents come first
        if parent >= 0:
            up[bone] = np.where(up[parent] >= 0, up[parent] + 1, -1)
        up[bone, bone] = 0
    return up


def kinship(parents: Array) -> Array:
    """(B, B) int8 index into `RELATIONS`: what bone b (column) is to bone a (row)."""
    parents = np.asarray(parents)
    up = ancestry(parents)
    out = np.full(up.shape, RELATIONS.index("distant"), np.int8)
    known = parents >= 0
    same = (parents[:, None] == parents[None]) & known[:, None] & known[None]
    # Row r of `above`: the bones that are parent of r.
    above = np.zeros(up.shape, bool)
    above[np.flatnonzero(known), parents[known]] = True
    uncle = (above.astype(np.float32) @ same.astype(np.float32)) > 0
    uncle &= ~above
    cousin = (uncle.astype(np.float32) @ above.T.astype(np.float32)) > 0
    # The last assignment wins: from the farthest kin to the closest.
    for name, mask in (
        ("cousin", cousin),
        ("uncle", uncle),
        ("nephew", uncle.T),
        ("ancestor", up > 2),
        ("descendant", up.T > 2),
        ("grandparent", up == 2),
        ("grandchild", up.T == 2),
        ("sibling", same),
        ("parent", up == 1),
        ("child", up.T == 1),
        ("self", np.eye(len(parents), dtype=bool)),
    ):
        out[mask] = RELATIONS.index(name)
    return out


def bone_features(skeleton: Skeleton, tips: Array, size: float) -> Array:
    """(B, len(BONE_FEATURES)) float32, the same in every position, turn and size of the object.

    tips (B, 3): where each bone really ends; size: the object's diagonal.
    """
    parents, heads = skeleton.parents, skeleton.heads
    count = skeleton.count
    up = ancestry(parents)
    axis = tips - heads
    length = np.maximum(np.linalg.norm(axis, axis=1), 1e-6 * size)
    axis = axis / length[:, None]
    depth = up.max(axis=1)
    subtree = (up >= 0).sum(axis=0)
    height = np.array([up[:, b].max() for b in range(count)])
    children = np.bincount(parents[parents >= 0], minlength=count)
    has = parents >= 0
    above = np.where(has, parents, 0)
    turn = np.where(has, (axis * axis[above]).sum(axis=1), 0.0)
    span = np.linalg.norm(heads - tips[above], axis=1)
    gap = np.where(has, span, 0.0)
    closeness = np.linalg.norm(heads[:, None] - heads[None], axis=-1) + np.linalg.norm(
        tips[:, None] - tips[None], axis=-1
    )
    np.fill_diagonal(closeness, np.inf)
    twin = closeness.min(axis=1) < 0.02 * size if count > 1 else np.zeros(1, bool)
    siblings = np.where(has, children[above] - 1, (~has).sum() - 1)
    columns = [
        np.log(length / size), depth / 8, height / 8, np.minimum(children, 6) / 3, children == 0, ~has,
        np.log(subtree / count), turn, np.where(has, np.log(length / length[above]), 0).clip(-3, 3), twin,
        np.log(gap / size + 0.01), np.minimum(siblings, 8) / 4,
    ]  # fmt: skip
    return np.stack([np.asarray(c, np.float32) for c in columns], axis=1)
