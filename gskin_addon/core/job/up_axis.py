# SPDX-License-Identifier: GPL-3.0-or-later
"""The up axis of a splat file, chosen or guessed, where an armature may tell more than the splats do."""

from __future__ import annotations

import numpy as np

from ..rig.skeleton import Skeleton
from ..splats.axes import UP_AXES, up_rotation
from ..splats.cloud import Floats, SplatCloud
from ..splats.up_axis import UpGuess, guess_up
from .checks import overlap

AUTO = "auto"
UP_CHOICES = (AUTO, *UP_AXES)
"""What can be chosen where a file is read; "auto" guesses."""

_INSIDE = 0.8
_BETTER = 0.3


def resolve_up(up: str, cloud: SplatCloud, skeleton: Skeleton | None = None) -> tuple[str, str]:
    """The axis of `UP_AXES` for a choice of `UP_CHOICES`, and what was assumed in a sentence ("" where chosen).

    cloud: with the file's own axes; skeleton: in Blender's world, if there is one. Raises InputError for another name.
    """
    if up != AUTO:
        up_rotation(up)
        return up, ""
    guess = guess_up_for(cloud, skeleton) if skeleton is not None else guess_up(cloud)
    if not guess.sure and cloud.up:
        guess = UpGuess(cloud.up, "as its format says", 1.0)
    return guess.axis, f"assumed {guess.sentence}"


def guess_up_for(cloud: SplatCloud, skeleton: Skeleton) -> UpGuess:
    """The axis that brings the splats around the bones; where several or none do, what the splats tell."""
    points = cloud.means[:: max(1, cloud.count // 50_000)].astype(np.float64)
    shares = {up: overlap_in_file(points, cloud.offset, skeleton, up) for up in UP_AXES}
    best = max(shares, key=lambda up: shares[up])
    others = max(share for up, share in shares.items() if up != best)
    if shares[best] >= _INSIDE and shares[best] >= others + _BETTER:
        return UpGuess(best, f"so {shares[best]:.0%} of the armature's bones lie within the splats", shares[best])
    return guess_up(cloud)


def overlap_in_file(points: Floats, offset: Floats, skeleton: Skeleton, up: str) -> float:
    """Share (0 to 1) of the bones within `points` (N, 3) that have the file's axes, with `up` pointing up.

    The armature may have been made for the file's coordinates, or for those that splats far from the origin (offset
    (3,), see `SplatCloud`) are moved to.
    """
    R = up_rotation(up)
    here = overlap(points @ R.T, skeleton)
    if not offset.any():
        return here
    return max(here, overlap(points @ R.T, skeleton.moved(np.eye(3), translation=-R @ offset)))
