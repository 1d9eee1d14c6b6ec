# SPDX-License-Identifier: GPL-3.0-or-later
"""In what shape an asset comes before a method and its judge: disturbed skeletons, isotropic splats, on its mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.assets import ASSETS, RiggedSplats
from gskin_addon.core.training.rigged import read_rigged_mesh

from .judge import Judge
from .lpips import Perceptual
from .perturb import DISTURBANCES, Disturbed, own
from .protocol import Protocol

ISOTROPIC, ANCHORED = "isotropic", "anchored"


def isotropic(asset: RiggedSplats) -> Disturbed:
    """Splats that are balls of the same volume (paper, Table I)."""
    cloud = asset.cloud
    radius = np.exp(np.log(np.maximum(cloud.scales, 1e-12)).mean(axis=1, keepdims=True))
    return own(replace(asset, cloud=replace(cloud, scales=np.repeat(radius, 3, axis=1), stored={})))


CASES = DISTURBANCES | {ISOTROPIC: isotropic, ANCHORED: own}
"""By name; a result's field `skeleton` says which."""


def judge_of(case: str, asset: RiggedSplats, protocol: Protocol, lpips: Perceptual | None) -> Judge:
    """The judge of an asset in a case."""
    if case != ANCHORED:
        return Judge(asset, protocol, lpips)
    from .anchored import AnchoredJudge

    return AnchoredJudge(asset, read_rigged_mesh(ASSETS / "npz" / f"{asset.name}.npz"), protocol, lpips)
