# SPDX-License-Identifier: GPL-3.0-or-later
"""Control points as LightningDrag reads them: maps whose pixels hold the points' numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..control import ControlSignal

SIDE_STEP = 64
SPARSE = 20
"""Points that the published checkpoint takes well; with dense ones it fails (G-Skin, Sec. IV)."""


def check_size(height: int, width: int) -> None:
    """Raise InputError unless the UNet's coarsest resolution divides the image."""
    if height % SIDE_STEP or width % SIDE_STEP or height < SIDE_STEP or width < SIDE_STEP:
        raise InputError(
            f"The lightning_drag guidance makes images whose sides are multiples of {SIDE_STEP}, "
            f"not {width} x {height}; choose another image size."
        )


def point_maps(handles: NDArray[Any], targets: NDArray[Any], height: int, width: int) -> NDArray[np.float32]:
    """(2, height, width): pixel of handle i holds i + 1 in map 0, pixel of target i in map 1; 0 elsewhere.

    handles, targets (K, 2): pixel positions (x, y); pixel (column, row) covers [column, column + 1). Pairs with
    an end outside the image are dropped before numbering; where points share a pixel the last one stays.
    """
    pairs = np.concatenate([handles, targets], axis=1).astype(np.float64)
    pixels = np.floor(pairs[_inside(handles, targets, height, width)]).astype(np.int64)
    maps = np.zeros((2, height, width), np.float32)
    for number, (hx, hy, tx, ty) in enumerate(pixels, start=1):
        maps[0, hy, hx] = number
        maps[1, ty, tx] = number
    return maps


def point_facts(signals: Sequence[ControlSignal], most: int) -> dict[str, int]:
    """How many control points the model is not shown, for a report.

    limit: `most`, 0 for none; images, points: of all signals; images_over, dropped: images with more points than the
    limit, and the points that `farthest_points` leaves out of them; outside: of the others, those that `point_maps`
    leaves out since they start or end outside the image.
    """
    over = dropped = outside = points = 0
    for signal in signals:
        handles, targets = farthest_points(signal.handles, signal.targets, most)
        points += len(signal.handles)
        dropped += len(signal.handles) - len(handles)
        over += len(handles) < len(signal.handles)
        outside += int((~_inside(handles, targets, *signal.camera.size)).sum())
    return {
        "limit": most,
        "images": len(signals),
        "images_over": over,
        "points": points,
        "dropped": dropped,
        "outside": outside,
    }


def _inside(handles: NDArray[Any], targets: NDArray[Any], height: int, width: int) -> NDArray[np.bool_]:
    """(K,) bool: pairs with both ends in the image."""
    pairs = np.concatenate([handles, targets], axis=1)
    inside: NDArray[np.bool_] = ((pairs >= 0) & (pairs < (width, height, width, height))).all(axis=1)
    return inside


def farthest_points(handles: NDArray[Any], targets: NDArray[Any], most: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """At most `most` of the K pairs (K, 2), (K, 2), far from each other, in their order; 0 means all.

    Farthest-point sampling on (handle, target) in pixels; it starts at the pair that moves most.
    """
    if not most or len(handles) <= most:
        return handles, targets
    pairs = np.concatenate([handles, targets], axis=1).astype(np.float64)
    chosen = [int(np.linalg.norm(pairs[:, 2:] - pairs[:, :2], axis=1).argmax())]
    reach = np.linalg.norm(pairs - pairs[chosen[0]], axis=1)
    while len(chosen) < most:
        chosen.append(int(reach.argmax()))
        reach = np.minimum(reach, np.linalg.norm(pairs - pairs[chosen[-1]], axis=1))
    kept = np.sort(chosen)
    return handles[kept], targets[kept]
