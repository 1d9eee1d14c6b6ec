# SPDX-License-Identifier: GPL-3.0-or-later
"""Input that can be refused before any work is done, in words a person can act on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..rig.skeleton import Skeleton
from ..splats.axes import UP_AXES, up_rotation
from ..splats.cloud import SplatCloud

MAX_SPLATS = 5_000_000
"""Beyond this the optimisation needs more memory than a workstation can be expected to have."""

SOUND, APART = 0.7, 0.1
"""Shares of the bones within the splats: from the first on all is well, below the second a job is refused."""

_BONE_SAMPLES = 5


def check_inputs(
    cloud: SplatCloud,
    skeleton: Skeleton,
    *,
    splats: str = "The splats",
    armature: str = "The armature",
    up: str = "z",
) -> None:
    """Refuse what cannot be skinned.

    Args:
        cloud, skeleton: in the same world space.
        splats, armature: what to call them in messages.
        up: the up axis the splat file was read with ("z", "y", "-y"), for the advice about axes.

    Raises:
        InputError: fewer than 2 or more than `MAX_SPLATS` splats, splats without size or that are not finite,
            no bones, bones of zero length, or bones that lie outside the splats.
    """
    if cloud.count < 2:
        raise InputError(
            f"{splats} has {cloud.count} splat{'' if cloud.count == 1 else 's'}, nothing to skin; "
            "choose an object that was imported from a Gaussian splat .ply."
        )
    if cloud.count > MAX_SPLATS:
        raise InputError(
            f"{splats} has {cloud.count:,} splats, more than the {MAX_SPLATS:,} that one job can skin; "
            "crop the scene to the character, or thin it out, and try again."
        )
    if not np.isfinite(cloud.means).all():
        raise InputError(
            f"{splats} has centres that are not finite numbers; import the file again without them."
        )
    lower, upper = cloud.bounds()
    if not np.any(upper > lower):
        raise InputError(f"{splats} has all its splats at one point; choose another object or file.")
    skeleton.validate(armature)
    points = cloud.means[:: max(1, cloud.count // 100_000)].astype(np.float64)
    check_overlap(points, skeleton, splats, armature, up)


def overlap(points: NDArray[Any], skeleton: Skeleton) -> float:
    """Share (0 to 1) of the bones that lies in the box of `points` (N, 3), widened by a tenth of its size.

    The box leaves out the outermost hundredth on each side: captures have stray splats.
    """
    lower, upper = np.percentile(points, [1, 99], axis=0)
    margin = 0.1 * float(np.linalg.norm(upper - lower))
    along = np.linspace(0.0, 1.0, _BONE_SAMPLES)[:, None, None]
    samples = skeleton.heads + along * (skeleton.tails - skeleton.heads)
    inside = np.all((samples >= lower - margin) & (samples <= upper + margin), axis=-1)
    return float(inside.mean())


def better_axis(points: NDArray[Any], skeleton: Skeleton, up: str) -> tuple[float, str, float]:
    """Share of the bones within `points` (N, 3), and where another up axis fits far better its name and share.

    up: the axis the splat file was read with. The name is "" where the present axis is as good as the others.
    """
    here = overlap(points, skeleton)
    # Sound rigs may have a third of their bones outside (props, tails, control bones), so the share alone
    # convicts only when it is nearly nothing; a wrong axis shows as another axis fitting far better.
    if here >= SOUND:
        return here, "", here
    elsewhere = {
        other: overlap(points @ (up_rotation(other) @ up_rotation(up).T).T, skeleton)
        for other in UP_AXES
        if other != up
    }
    best = max(elsewhere, key=lambda name: elsewhere[name])
    return (here, best, elsewhere[best]) if elsewhere[best] >= here + 0.3 else (here, "", here)


def check_overlap(points: NDArray[Any], skeleton: Skeleton, splats: str, armature: str, up: str) -> None:
    """Raise InputError, as `check_inputs` does, where the bones lie outside `points` (N, 3), splats in the world."""
    here, best, there = better_axis(points, skeleton, up)
    if best:
        raise InputError(
            f"{armature} does not overlap {_inner(splats)}: only {here:.0%} of its bones lie within them; "
            f"with {best.upper()} up it would be {there:.0%}, "
            f"so import the splats with Up set to {best.upper()}.",
            terminal=f"--ply-up={best}",
        )
    if here < APART:
        raise InputError(
            f"{armature} does not overlap {_inner(splats)}: only {here:.0%} of its bones lie within them; "
            "move or scale the armature onto the splats, or import the splats with another Up axis.",
            terminal="--ply-up=z, y or -y",
        )


def _inner(name: str) -> str:
    """A name in the middle of a sentence."""
    return name[:1].lower() + name[1:] if name.startswith("The ") else name
