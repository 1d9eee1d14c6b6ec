# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights that no longer cross a wall: neither side follows a bone that is the other's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.nearest_points import nearest_points
from ...rig.skeleton import Skeleton
from ..learned.tree import ancestry
from .blend import follow_neighbours
from .body_graph import body_graph
from .separate import FAR, steps_between

Array = NDArray[Any]

LOST = 0.5
"""Share of a splat's weight from which on, where it is taken away, the splats around say what takes its place; below,
the rest of its own weights does."""

_AROUND = 0.03  # of the body's diagonal: splats so close to those that have lost theirs take part


def keep_apart(
    weights: Array, means: Array, labels: Array, skeleton: Skeleton, *, bones: Mapping[int, int] | None = None
) -> tuple[Array, Array]:
    """Weights (N, B) float32 and the splats (N,) bool that changed.

    A marked part keeps the weights of bones near its own: the one that most of it follows, or that of `bones`, by
    label. What it touches loses those of that bone, of the bones below it, and of the one that holds it. Splats that
    lose most of theirs take the weights that pass most smoothly between those around them, on their side of the walls.
    Splats without a label stay.

    weights (N, B), rows sum to 1; means (N, 3) metres; labels (N,): see `walls`; marked parts have odd ones and what
    they touch even ones, as `separate` gives them.
    """
    labels, means = np.asarray(labels), np.asarray(means, np.float64)
    out = np.array(weights, np.float32)
    lost = np.zeros(len(out), np.float32)
    denied = [*_barred(out, means, labels, skeleton, bones or {})]
    for rows, barred in denied:
        lost[rows] = out[np.ix_(rows, barred)].sum(axis=1)
        out[np.ix_(rows, barred)] = 0
    changed, open_ = lost > 0, lost > LOST
    total = out.sum(axis=1, dtype=np.float64)
    out[changed] /= np.maximum(total[changed], 1e-12)[:, None].astype(np.float32)
    if open_.any():
        rim = _AROUND * float(np.linalg.norm(np.ptp(means, axis=0)))
        low, high = means[open_].min(axis=0) - rim, means[open_].max(axis=0) + rim
        part = np.flatnonzero((means >= low).all(axis=1) & (means <= high).all(axis=1))
        filled, alone = follow_neighbours(out[part], body_graph(means[part], walls=labels[part]), open_[part])
        out[part[open_[part]]] = filled[open_[part]]
        # Splats beside the seam that have no label may still follow what is denied here.
        for rows, barred in denied:
            rows = rows[open_[rows]]
            mine = out[rows]
            mine[:, barred] = 0
            left = mine.sum(axis=1, keepdims=True)
            out[rows] = np.where(left > 1e-6, mine / np.maximum(left, 1e-6), out[rows])
        # What stands alone with nothing left of its own keeps what it had.
        bare = part[alone & (total[part] <= 1e-6)]
        out[bare], changed[bare] = weights[bare], False
    return out, changed


def _barred(
    weights: Array, means: Array, labels: Array, skeleton: Skeleton, bones: Mapping[int, int]
) -> Iterator[tuple[Array, Array]]:
    """Splats (R,) and the bones (K,) that they may not follow, part by part."""
    steps, below = steps_between(skeleton.parents), ancestry(skeleton.parents) >= 0
    marked = np.flatnonzero(labels % 2 == 1)
    beside = np.flatnonzero((labels != 0) & (labels % 2 == 0))
    touched = labels[:0]
    if len(marked) and len(beside):
        touched = labels[marked[nearest_points(means[marked], means[beside], 1)[1][:, 0]]]
    for label in np.unique(labels[marked]).tolist():
        rows = np.flatnonzero(labels == label)
        main = bones.get(label, int(np.asarray(weights[rows], np.float64).sum(axis=0).argmax()))
        yield rows, np.flatnonzero(steps[main] >= FAR)
        yield beside[touched == label], np.flatnonzero(below[:, main] | (steps[main] <= 1))
