# SPDX-License-Identifier: GPL-3.0-or-later
"""Small bones do not carry what lies out of their reach: a club follows the hand and not the thumb beside it.

The network judges each splat by the bones nearest to it, and the nearest to something held in a hand, or to a hat over
a face with many bones, is any of the small ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.nearest_points import nearest_points
from ...rig.segments import BoneSegments, bone_segments, segment_distance
from ...rig.skeleton import Skeleton
from ...splats.components import connected_components
from .parts import TOUCH
from .tree import ancestry

Array = NDArray[Any]

FINGERS = 3
"""Fewest short chains from one bone that make a hand."""

LONGEST = 0.1
"""Length of a finger, as a part of the object's diagonal, from which on it is a limb."""

TOGETHER = 0.1
"""Distance between the first joints of the fingers, in finger lengths, below which they start in the wrist."""

SKIN, BEYOND = 0.25, 1.0
"""Distances from a finger, in finger lengths: where its flesh ends, and what no flesh of a finger reaches."""

OWNED = 0.5
"""Share of the fingers from which on a splat is theirs."""

SMALLEST = 8
"""Fewest splats of a thing."""

_LINKS = 6


@dataclass(frozen=True)
class Hand:
    """fingers: their bones; palm: the bone that what they hold follows; reach: the usual length of a finger."""

    fingers: Array
    palm: int
    reach: float


def find_hands(skeleton: Skeleton, segments: BoneSegments, size: float) -> list[Hand]:
    """Bones all of whose children are short chains: hands, and faces.

    segments: of the skeleton; size: the object's diagonal. A lone bone among jointed fingers is no finger but a place
    for a tool. The palm is the common parent; where the fingers start in the wrist, the first bone of the finger that
    goes on as the arm went.
    """
    lengths = np.zeros(skeleton.count)
    np.maximum.at(lengths, segments.bone, np.linalg.norm(segments.ends - segments.starts, axis=1))
    below = ancestry(skeleton.parents) >= 0
    hands = []
    for bone in np.flatnonzero(skeleton.parents >= 0):
        chains = [np.flatnonzero(below[:, child]) for child in skeleton.children(bone)]
        if len(chains) < FINGERS or max(lengths[chain].sum() for chain in chains) > LONGEST * size:
            continue
        if any(len(chain) > 1 for chain in chains):
            chains = [chain for chain in chains if len(chain) > 1]
        reach = float(np.median([lengths[chain].sum() for chain in chains]))
        starts = skeleton.heads[[chain[0] for chain in chains]]
        if len(chains) < FINGERS or reach <= 0:
            continue
        spread = np.median(np.linalg.norm(starts - np.median(starts, axis=0), axis=1))
        palm = int(bone) if spread > TOGETHER * reach else _straight_on(skeleton, int(bone), chains)
        hands.append(Hand(np.concatenate(chains), palm, reach))
    return hands


def hold(weights: Array, points: Array, skeleton: Skeleton, size: float) -> Array:
    """Weights (N, B) in which the palm has what the fingers had of things out of their reach; points (N, 3).

    A thing is a connected set of splats that follow the fingers, off their flesh, at least one of them far off. size:
    the object's diagonal.
    """
    segments = bone_segments(skeleton)
    out = weights
    for hand in find_hands(skeleton, segments, size):
        mine = np.flatnonzero(np.isin(segments.bone, hand.fingers))
        ways = [segment_distance(points, segments.starts[k], segments.ends[k]) for k in mine]
        away = np.min(ways, axis=0) / hand.reach
        off = np.flatnonzero((out[:, hand.fingers].sum(axis=1) > OWNED) & (away > SKIN))
        if len(off) < SMALLEST or away[off].max() <= BEYOND:
            continue
        piece = _pieces(points[off])
        far, count = np.zeros(piece.max() + 1), np.bincount(piece)
        np.maximum.at(far, piece, away[off])
        held = off[((far > BEYOND) & (count >= SMALLEST))[piece]]
        out = out.copy()
        taken = out[np.ix_(held, hand.fingers)].sum(axis=1)
        out[np.ix_(held, hand.fingers)] = 0
        out[held, hand.palm] += taken
    return out


def _straight_on(skeleton: Skeleton, bone: int, chains: list[Array]) -> int:
    """The first bone of the chain whose way is most like that of `bone`."""
    axis = skeleton.tails[bone] - skeleton.heads[bone]
    ways = np.array([skeleton.tails[chain[-1]] - skeleton.heads[chain[0]] for chain in chains])
    cosine = ways @ axis / np.maximum(np.linalg.norm(ways, axis=1), 1e-12)
    return int(chains[int(np.argmax(cosine))][0])


def _pieces(points: Array) -> Array:
    """(N,) labels: splats that touch, or nearly, have the same."""
    way, index = nearest_points(points, points, min(_LINKS + 1, len(points)))
    row, column = np.nonzero(way[:, 1:] < TOUCH * np.median(way[:, 1:]))
    label = connected_components(len(points), row, index[row, column + 1])
    return np.unique(label, return_inverse=True)[1].reshape(-1)
