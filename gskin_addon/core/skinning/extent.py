# SPDX-License-Identifier: GPL-3.0-or-later
"""Size and position of an object, robust to stray splats; numpy only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def robust_bounds(points: Array, percent: float = 1.0, reach: float = 0.25) -> tuple[Array, Array]:
    """Lower and upper corner (3,) of the bounding box of `points` (N, 3) without far strays.

    The box between the `percent` and 100 - `percent` percentiles, grown by `reach` of its own size on every
    side, decides which points are strays; the result is the exact bounding box of the others. So a clean object keeps
    its true box.
    """
    points = np.asarray(points, dtype=np.float64)
    low, high = np.percentile(points, [percent, 100 - percent], axis=0)
    # A flat object has no thickness along one axis: let the largest side count for a part of the margin.
    grow = reach * (high - low) + 0.05 * (high - low).max()
    inside = ((points >= low - grow) & (points <= high + grow)).all(axis=1)
    kept = points[inside] if inside.any() else points
    return kept.min(axis=0), kept.max(axis=0)


def unit_frame(points: Array) -> tuple[Array, float]:
    """Centre (3,) and bounding-box diagonal of an object: (points - centre) / diagonal has unit size.

    A single point or coinciding points give the diagonal 1.
    """
    low, high = robust_bounds(points)
    diagonal = float(np.linalg.norm(high - low))
    return (low + high) / 2, diagonal if diagonal > 0 else 1.0
