# SPDX-License-Identifier: GPL-3.0-or-later
"""The up axis of a splat file, chosen or guessed, where an armature may tell more than the splats do."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..rig.rig_scale import misfit
from ..rig.skeleton import Skeleton
from ..splats.axes import UP_AXES, up_rotation
from ..splats.cloud import Floats, SplatCloud
from ..splats.up_axis import UpGuess, guess_up
from ..splats.up_said import up_of_cameras
from .checks import SOUND, overlap

AUTO = "auto"
UP_CHOICES = (AUTO, *UP_AXES)
"""What can be chosen where a file is read; "auto" guesses."""

_INSIDE = 0.8
_BETTER = 0.3
_CLOSER, _CLOSE = 0.7, 0.6
"""Part of the next best axis' misfit that the best may have, and the most that it may be. On 131 rigged assets turned
to each of three axes, bones alone were right for 343 of 393, wrong for none."""


def resolve_up(
    up: str, cloud: SplatCloud, skeleton: Skeleton | None = None, path: Path | None = None
) -> tuple[str, str]:
    """The axis of `UP_AXES` for a choice of `UP_CHOICES`, and what was assumed in a sentence ("" where chosen).

    cloud: with the file's own axes; skeleton: in Blender's world, if there is one; path: of the file, beside which
    cameras may lie. What tells comes first where it is surest: bones, the cameras, what the splats stand on, then what
    the file says, because programs write that without knowing. Raises InputError for another name.
    """
    if up != AUTO:
        up_rotation(up)
        return up, ""
    guess = guess_up_for(cloud, skeleton, path) if skeleton is not None else _of_capture(cloud, path)
    if not guess.sure and cloud.up:
        guess = UpGuess(cloud.up, _who_says(path), 1.0)
    return guess.axis, f"assumed {guess.sentence}"


def default_up(cloud: SplatCloud, skeleton: Skeleton, path: Path | None = None) -> tuple[str, str]:
    """The axis where none was chosen, as the file says or z, unless bones contradict; and why it is not z ("")."""
    said = cloud.up or "z"
    found = _of_bones(cloud, skeleton)
    if found is not None and found.axis != said:
        return found.axis, f"assumed {found.sentence}"
    return said, f"assumed {said.upper()} up, {_who_says(path)}" if cloud.up and cloud.up != "z" else ""


def guess_up_for(cloud: SplatCloud, skeleton: Skeleton, path: Path | None = None) -> UpGuess:
    """The axis that brings the splats around the bones; where several or none do, what the capture tells."""
    return _of_bones(cloud, skeleton) or _of_capture(cloud, path)


def _of_capture(cloud: SplatCloud, path: Path | None) -> UpGuess:
    """What cameras beside the file tell, else the splats."""
    seen = up_of_cameras(path) if path is not None else ""
    if seen:
        return UpGuess(seen, "as its cameras were held", 1.0)
    # "y" leaves open which of its ends, and some programs write it always; nobody writes z without cause.
    return UpGuess("z", _who_says(path), 1.0) if cloud.up == "z" else guess_up(cloud)


def _who_says(path: Path | None) -> str:
    return "as its header says" if path is not None and path.suffix.lower() == ".ply" else "as its format says"


def _of_bones(cloud: SplatCloud, skeleton: Skeleton) -> UpGuess | None:
    """The axis with which the bones lie in the splats; None where they do not tell."""
    points = cloud.means[:: max(1, cloud.count // 50_000)].astype(np.float64)
    rigs = {up: _places(cloud.offset, skeleton, up) for up in UP_AXES}
    shares = {up: max(overlap(points @ up_rotation(up).T, rig) for rig in rigs[up]) for up in UP_AXES}
    best = max(shares, key=lambda up: shares[up])
    others = max(share for up, share in shares.items() if up != best)
    reason = f"so {shares[best]:.0%} of the armature's bones lie within the splats"
    if shares[best] >= _INSIDE and shares[best] >= others + _BETTER:
        return UpGuess(best, reason, shares[best])
    # Upside down, or on its back, the bones may still lie in the box of the splats.
    off = {up: min(misfit(points @ up_rotation(up).T, rig) for rig in rigs[up]) for up in UP_AXES}
    best, second = sorted(UP_AXES, key=lambda up: off[up])[:2]
    if shares[best] >= SOUND and off[best] < min(_CLOSE, _CLOSER * off[second]):
        return UpGuess(best, "so the armature's bones run inside the splats", 1.0 - off[best] / off[second])
    return None


def _places(offset: Floats, skeleton: Skeleton, up: str) -> list[Skeleton]:
    """Where the armature may stand: as it is, and, for splats that were moved from far off (offset (3,), see
    `SplatCloud`), moved with them."""
    if not offset.any():
        return [skeleton]
    return [skeleton, skeleton.moved(np.eye(3), translation=-up_rotation(up) @ offset)]
