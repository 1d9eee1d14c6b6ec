# SPDX-License-Identifier: GPL-3.0-or-later
"""Seams between parts of a body that touch but do not belong together, such as a helmet held against a thigh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...rig.nearest_points import nearest_points
from ...rig.segments import BoneSegments, bone_segments, segment_distance
from ...rig.skeleton import Skeleton
from .body_graph import along_body, body_graph

Array = NDArray[Any]

FAR = 3
"""Bones at least so many steps apart in the skeleton belong to parts that have nothing to do with one another."""

REACH = 0.05
"""How far from a marked part the other side of its seam goes unless told, as a share of the body's diagonal."""

_WIDE = 0.15  # of the diagonal: so far around the part it is found out which side the splats are on
_SURE = 2.0  # times nearer to the bones of one side than to those of the other
_CLEAR = 0.9  # share of a splat's weight
_INSIDE = 0.5  # share of the splats around a bone


def separate(
    means: Array,
    weights: Array,
    skeleton: Skeleton,
    selected: Array,
    reach: float = 0.0,
    *,
    bone: int | None = None,
    sides: Array | None = None,
) -> Array:
    """Labels (N,) int64 as walls, see `walls`, with a seam between the selected splats and the foreign ones they touch.

    The selection is one side. The other side is every splat within `reach` of it that belongs to bones at least `FAR`
    steps from the selection's: what holds the selection stays without a label, so that it keeps its hold. Weights of
    the selection's bones do not say that a splat belongs to them, since such weights are what is wrong here: where they
    and the places of the bones do not agree, the way along the body to splats where they do decides, none of it through
    the selection.

    means (N, 3) metres; weights (N, B) of the splats now; selected (N,) bool; reach in metres, 0 for `REACH`; bone:
    that which the selection is to follow, by default the one that most of it follows; sides (N,): labels of earlier
    seams, which stay where the new one does not run. Marked parts have odd labels, what they touch even ones; where the
    other sides of two seams meet they get one label, so that no wall lies within.

    Raises:
        InputError: no foreign splats within reach.
    """
    means, selected = np.asarray(means, np.float64), np.asarray(selected, bool)
    labels = np.zeros(len(means), np.int64) if sides is None else np.asarray(sides, np.int64).copy()
    if bone is None:
        bone = int(np.asarray(weights, np.float64)[selected].sum(axis=0).argmax())
    size = float(np.linalg.norm(np.ptp(means, axis=0)))
    reach = reach or REACH * size
    own = means[selected]
    rows, close = (
        np.flatnonzero(_around(means, own, way) & ~selected & (labels % 2 == 0))
        for way in (max(_WIDE * size, reach), reach)
    )
    near = close
    if len(close):
        # Only in the smaller box: how far it is to what lies outside would take ten times as long.
        beside = close[nearest_points(own, means[close], 1)[0][:, 0] <= reach]
        foreign = np.zeros(len(means), bool)
        foreign[rows] = _foreign(means, weights, skeleton, selected, rows, bone)
        near = beside[foreign[beside]]
    if not len(near):
        raise InputError(
            f"No splats within {reach:.3g} m of the selection follow a bone far from '{skeleton.names[bone]}'; choose "
            "the bone that the selection belongs to, or a larger reach."
        )
    first = int(labels.max(initial=0)) + 1
    first += first % 2 == 0
    met = np.unique(labels[near])
    labels[selected], labels[near] = first, first + 1
    for label in met[(met > 0) & (met % 2 == 0)]:
        labels[labels == label] = first + 1
    return labels


def _around(means: Array, own: Array, way: float) -> Array:
    """(N,) bool: which of means (N, 3) lie in the box around own (M, 3) that is `way` wider on each side."""
    return np.asarray((means >= own.min(axis=0) - way).all(axis=1) & (means <= own.max(axis=0) + way).all(axis=1))


def _foreign(
    means: Array, weights: Array, skeleton: Skeleton, selected: Array, rows: Array, bone: int
) -> Array:
    """(R,) bool: which of the splats `rows` (R,) belong to bones far from `bone`."""
    far = steps_between(skeleton.parents)[bone] >= FAR
    segments = bone_segments(skeleton)
    # Nothing outside the selection is the flesh of a bone that lies in it.
    outside = ~_bones_within(means, segments, selected)
    points = means[rows]
    to_near, to_far = (_distance(points, segments, outside & side) for side in (~far, far))
    follows = np.asarray(weights[rows])
    # What leaks is the weight of the selection's bones; what follows others is hardly ever wrong.
    theirs = (to_far * _SURE < to_near) | (follows[:, far].sum(axis=1) >= _CLEAR)
    ours = (to_near * _SURE < to_far) | ((follows[:, outside & ~far].sum(axis=1) >= _CLEAR) & (to_near <= to_far))
    ours &= ~theirs
    graph = body_graph(points)
    limit = float(np.linalg.norm(np.ptp(points, axis=0)))
    way_ours, way_theirs = along_body(graph, ours, limit), along_body(graph, theirs, limit)
    lost = np.isinf(way_ours) & np.isinf(way_theirs)
    return np.where(lost, to_far < to_near, way_theirs < way_ours)


def _bones_within(means: Array, segments: BoneSegments, selected: Array) -> Array:
    """(B,) bool: bones around which most splats are selected."""
    share = np.linspace(0.05, 0.95, 10)[:, None]
    places = segments.starts[:, None] * (1 - share) + segments.ends[:, None] * share
    near = nearest_points(means, places.reshape(-1, 3), min(8, len(means)))[1]
    mean = selected[near].reshape(len(segments.bone), -1).mean(axis=1)
    pieces = np.bincount(segments.bone)
    return np.asarray(np.bincount(segments.bone, mean) > _INSIDE * pieces)


def _distance(points: Array, segments: BoneSegments, bones: Array) -> Array:
    """(P,) metres from each point to the nearest of the bones (B,) bool; infinite without any."""
    out = np.full(len(points), np.inf)
    for k in np.flatnonzero(bones[segments.bone]):
        out = np.minimum(out, segment_distance(points, segments.starts[k], segments.ends[k]))
    return out


def steps_between(parents: Array) -> Array:
    """(B, B) int64: steps from each bone to each other one along the skeleton; between two trees all B.

    parents (B,): index, -1 for a root; a parent precedes its children.
    """
    count = len(parents)
    steps = np.full((count, count), count, np.int64)
    for bone, parent in enumerate(parents):
        if parent >= 0:
            steps[bone, :bone] = np.minimum(steps[parent, :bone] + 1, count)
            steps[:bone, bone] = steps[bone, :bone]
        steps[bone, bone] = 0
    return steps
