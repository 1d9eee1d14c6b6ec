# SPDX-License-Identifier: GPL-3.0-or-later
"""When the optimisation finds out anew which splats a view sees. Without torch: windows plan with it."""

from __future__ import annotations

from .presets import Preset

LOOK_EPOCHS = 4
"""What a view sees is found anew after the images were gone through so many times, and at each new size."""
PRUNE_FROM = 15_000
"""Splats from which on looking costs less than it saves."""


def look_schedule(preset: Preset, images: int) -> frozenset[int]:
    """The iterations before which the views find out what they see."""
    every = max(1, round(LOOK_EPOCHS * images / max(1, min(preset.batch, images))))
    return frozenset(look for _, stage in preset.ranges() for look in stage[::every])
