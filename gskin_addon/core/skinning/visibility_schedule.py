# SPDX-License-Identifier: GPL-3.0-or-later
"""When the optimisation determines again which splats a view sees. Without torch: windows plan with it."""

from __future__ import annotations

from .presets import Preset

VISIBILITY_EPOCHS = 4
"""The splats that a view sees are determined again after this many passes over the images, and at each new size."""
PRUNE_FROM = 15_000
"""From this many splats on, finding the visible ones costs less than it saves."""


def visibility_schedule(preset: Preset, images: int) -> frozenset[int]:
    """The iterations before which the views determine their visible splats."""
    every = max(1, round(VISIBILITY_EPOCHS * images / max(1, min(preset.batch, images))))
    return frozenset(look for _, stage in preset.ranges() for look in stage[::every])
