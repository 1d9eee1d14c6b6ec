# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones of a tree of joints: each joint is the head of one bone, which ends at the joint that goes on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..rig.skeleton import Skeleton, parents_first

Array = NDArray[Any]


def skeleton_of_joints(
    names: Sequence[str], parents: Sequence[int], places: Array, tails: Array | None = None, *, label: str
) -> Skeleton:
    """A skeleton with a bone for each joint.

    names: J, made unique where they are not; parents: J, -1 for a root; places (J, 3); tails (J, 3) or None: then a
    bone ends at its child, where it has several at the one that goes straightest on, and at the end of a limb goes on
    by half its parent's length. label names the file in messages.

    Raises:
        InputError: no joints, a number that is none, or parents in a circle.
    """
    places = np.asarray(places, np.float64)
    if not len(places):
        raise InputError(f"{label} has no joints; write the file again.")
    if not np.isfinite(places).all():
        raise InputError(f"{label} has a joint at NaN or infinity; write the file again.")
    if any(not -1 <= parent < len(places) for parent in parents):
        raise InputError(f"{label} has a joint whose parent is not there; write the file again.")
    try:
        order = parents_first(parents)
    except ValueError as error:
        raise InputError(f"{label} is no tree ({error}); write the file again.") from None
    rank = np.argsort(order)
    new_parents = np.array([-1 if parents[old] < 0 else int(rank[parents[old]]) for old in order])
    heads = places[order]
    ends = bone_ends(heads, new_parents) if tails is None else np.asarray(tails, np.float64)[order]
    size = float(np.ptp(heads, axis=0).max()) or 1.0
    short = ~(np.linalg.norm(ends - heads, axis=1) > 1e-4 * size)
    ends[short] = bone_ends(heads, new_parents)[short]
    return Skeleton(tuple(_unique([names[old] for old in order])), new_parents, heads, ends)


def bone_ends(heads: Array, parents: Array) -> Array:
    """Tails (B, 3) for bones at heads (B, 3), see `skeleton_of_joints`; parents (B,) come first."""
    size = float(np.ptp(heads, axis=0).max()) or 1.0
    tails = np.empty_like(heads)
    for bone in range(len(heads)):
        children = np.flatnonzero(parents == bone)
        ways = heads[children] - heads[bone]
        lengths = np.linalg.norm(ways, axis=1)
        children, ways, lengths = (values[lengths > 1e-4 * size] for values in (children, ways, lengths))
        parent = int(parents[bone])
        before = heads[bone] - heads[parent] if parent >= 0 else np.zeros(3)
        if len(children):
            straight = ways @ before / lengths if before.any() else lengths
            tails[bone] = heads[children[int(straight.argmax())]]
        elif float(np.linalg.norm(before)) > 1e-4 * size:
            tails[bone] = heads[bone] + before / 2
        else:
            tails[bone] = heads[bone] + np.array([0.0, 0.0, 0.05 * size])
    return tails


def _unique(names: Sequence[str]) -> list[str]:
    taken: set[str] = set()
    out = []
    for name in names:
        new, number = str(name).strip() or "joint", 1
        while new in taken:
            new, number = f"{str(name).strip() or 'joint'}.{number:03d}", number + 1
        taken.add(new)
        out.append(new)
    return out
