# SPDX-License-Identifier: GPL-3.0-or-later
"""Seams between parts of a body that touch but do not belong together, such as a helmet held against a thigh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...rig.nearest_points import nearest_points
from ...rig.skeleton import Skeleton

Array = NDArray[Any]

FAR = 3
"""Bones at least so many steps apart in the skeleton belong to parts that have nothing to do with one another."""


def separate(
    means: Array,
    weights: Array,
    skeleton: Skeleton,
    selected: Array,
    reach: float,
    *,
    bone: int | None = None,
    sides: Array | None = None,
) -> Array:
    """Labels (N,) int64 as walls, see `walls`, with a seam between the selected splats and the foreign ones they touch.

    The selection is one side. The other side is every splat within `reach` of it whose strongest bone is at least `FAR`
    steps from the selection's: what holds the selection stays without a label, so that it keeps its hold.

    means (N, 3) metres; weights (N, B) of the splats now; selected (N,) bool; reach in metres; bone: that which the
    selection is to follow, by default the one that most of it follows; sides (N,): labels of earlier seams, which stay
    where the new one does not run.

    Raises:
        InputError: no foreign splats within reach.
    """
    selected = np.asarray(selected, bool)
    strongest = np.asarray(weights).argmax(axis=1)
    if bone is None:
        bone = int(np.asarray(weights, np.float64)[selected].sum(axis=0).argmax())
    foreign = np.flatnonzero(~selected & (steps_between(skeleton.parents)[bone] >= FAR)[strongest])
    own = np.asarray(means, np.float64)[selected]
    near = foreign[:0]
    if len(foreign):
        inside = (means[foreign] >= own.min(axis=0) - reach).all(axis=1)
        inside &= (means[foreign] <= own.max(axis=0) + reach).all(axis=1)
        near = foreign[inside]
        near = near[nearest_points(own, means[near], 1)[0][:, 0] <= reach]
    if not len(near):
        raise InputError(
            f"No splats within {reach:.3g} m of the selection follow a bone far from '{skeleton.names[bone]}'; choose "
            "the bone that the selection belongs to, or a larger reach."
        )
    labels = np.zeros(len(means), np.int64) if sides is None else np.asarray(sides, np.int64).copy()
    first = int(labels.max(initial=0)) + 1
    labels[selected], labels[near] = first, first + 1
    return labels


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
