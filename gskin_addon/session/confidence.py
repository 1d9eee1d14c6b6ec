# SPDX-License-Identifier: GPL-3.0-or-later
"""How sure the weights of splats are, in a few numbers for panels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ..scene import names
from ..scene.attributes import read_attribute

SURE = 0.5
"""Confidence from which on a splat counts as sure at all."""

WORST = (0.01, 0.05, 0.10)
"""Shares of the least sure splats that a panel tells about and lets select."""


@dataclass(frozen=True)
class Spread:
    """How the confidence of splats is spread: it ranks them better than it counts, so shares say more than a bar.

    count: splats; sure: share of those that are sure at all; median; worst: for each share of `WORST` the confidence
    below which it lies.
    """

    count: int
    sure: float
    median: float
    worst: dict[float, float]


_spreads: dict[tuple[int, int], Spread] = {}


def spread_of(splats: bpy.types.Object) -> Spread | None:
    """The spread; None where the splats have no confidence, or are being edited.

    Remembered for the mesh: new weights come with a new one.
    """
    mesh: Any = splats.data
    if names.CONFIDENCE not in mesh.attributes or splats.mode == "EDIT":
        return None
    key = (mesh.session_uid, len(mesh.vertices))
    if key not in _spreads:
        values = read_attribute(mesh, names.CONFIDENCE)
        if values is None or not len(values):
            return None
        if len(_spreads) >= 8:
            _spreads.clear()
        *worst, median = (float(value) for value in np.quantile(values, [*WORST, 0.5]))
        sure = float(np.mean(values >= SURE))
        _spreads[key] = Spread(len(values), sure, median, dict(zip(WORST, worst, strict=True)))
    return _spreads[key]


def sure_share(splats: bpy.types.Object) -> float | None:
    """Share (0 to 1) of the splats whose weights are sure; None as `spread_of`."""
    spread = spread_of(splats)
    return None if spread is None else spread.sure
