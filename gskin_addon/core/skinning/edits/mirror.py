# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights of one side of a body for the other: bones by name and place, splats by their mirrored neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.mirror import mirror_plane, mirror_targets, mirrored
from ...rig.nearest_points import nearest_points
from ...rig.skeleton import Skeleton

Array = NDArray[Any]

SOURCES = ("left", "right")
NEAREST = 4
"""Splats around the mirrored place that a splat takes its weights from."""
REACH = 0.03
"""A mirrored place further than this share of the body's diagonal from every splat has no other side."""


def mirror(
    weights: Array, means: Array, skeleton: Skeleton, *, source: str = "left", selected: Array | None = None
) -> tuple[Array, Array]:
    """The side that is not `source` gets the weights of the source side, with each bone's partner in its place.

    weights (N, B), rows sum to 1; means (N, 3) metres, in the rest pose, world space as the skeleton; source: "left" or
    "right" by the bones' names; selected (N,) bool: only these change. Splats are not in pairs: each takes the mean of
    the `NEAREST` splats around its mirrored place, by their distance. Bones without a partner: see `mirror_targets`.

    Returns (N, B) float32, rows sum to 1, and (N,) bool: splats of that side that have no other side, which stay.

    Raises:
        InputError: no bones are named as left and right.
    """
    point, normal = mirror_plane(skeleton)
    target_of = mirror_targets(skeleton, point, normal)
    means = np.asarray(means, np.float64)
    off = (means - point) @ normal
    if source == "right":
        off = -off
    target = off < 0
    if selected is not None:
        target &= np.asarray(selected, bool)
    out = np.array(weights, np.float32)
    rows, given = np.flatnonzero(target), np.flatnonzero(off >= 0)
    alone = target.copy()
    if not len(rows) or not len(given):
        return out, alone
    way, index = nearest_points(means[given], mirrored(means[rows], point, normal), min(NEAREST, len(given)))
    near = way[:, 0] <= REACH * float(np.linalg.norm(np.ptp(means, axis=0)))
    rows, way, index = rows[near], way[near], given[index[near]]
    alone[rows] = False
    pull = 1 / (way + 1e-3 * (way.max(axis=1, keepdims=True) + 1e-12))
    pull /= pull.sum(axis=1, keepdims=True)
    mixed = np.zeros((len(rows), out.shape[1]))
    for k in range(way.shape[1]):
        mixed += pull[:, k, None] * out[index[:, k]]
    # Weights of a bone go to its partner; those of two bones with one partner add up.
    turned = np.zeros_like(mixed)
    for bone, other in enumerate(target_of):
        turned[:, other] += mixed[:, bone]
    out[rows] = turned / np.maximum(turned.sum(axis=1, keepdims=True), 1e-12)
    return out, alone
