# SPDX-License-Identifier: GPL-3.0-or-later
"""The dynamic mask (Sec. III-C): where the image may change between rest and pose, and where a model may paint."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

DIFFERENCE = 0.02
SMALLEST = 6
MASK_VERSION = 2
"""Of `painting_mask`: images that were made with another are made again."""


def dynamic_mask(rest: NDArray[Any], posed: NDArray[Any]) -> NDArray[np.bool_]:
    """Convex hulls of the connected regions in which two renders differ.

    Args:
        rest: (H, W, 3) render of the rest pose, in [0, 1].
        posed: (H, W, 3) render posed with the initial weights.

    Returns:
        (H, W) bool, true where the guidance may repaint. Regions under `SMALLEST` pixels are noise and left
        out; differences count from `DIFFERENCE` (five 8-bit steps) in any channel.
    """
    from PIL import Image, ImageDraw
    from scipy import ndimage
    from scipy.spatial import ConvexHull, QhullError

    changed = np.abs(posed - rest).max(axis=-1) > DIFFERENCE
    labels, _ = ndimage.label(changed, structure=np.ones((3, 3)))
    canvas = Image.new("1", changed.shape[::-1])
    draw = ImageDraw.Draw(canvas)
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        rows, columns = np.nonzero(labels[box] == number)
        if len(rows) < SMALLEST:
            continue
        points = np.stack([columns + box[1].start, rows + box[0].start], axis=1)
        try:
            points = points[ConvexHull(points).vertices]
        except QhullError:  # all pixels on one line: the line is its own hull
            points = points[[0, -1]]
        draw.polygon([(int(x), int(y)) for x, y in points], fill=1, outline=1)
    return np.asarray(canvas, dtype=bool) | (changed & (labels > 0) & _large(labels))


def painting_mask(
    rest: NDArray[Any], posed: NDArray[Any], handles: NDArray[Any], targets: NDArray[Any]
) -> NDArray[np.bool_]:
    """Where a guidance model may paint: the dynamic mask together with the hull of the control points.

    The initial weights do not move all that truly moves, and a joint that leaves their mask could not be followed.
    Providers use this mask, and `train-guidance pairs` trains on it. Empty where the dynamic mask is.

    Args:
        rest, posed: as in `dynamic_mask`.
        handles, targets: (K, 2) pixel positions (x, y) of the control points, inside the image or not.
    """
    mask = dynamic_mask(rest, posed)
    return mask | points_hull(handles, targets, *mask.shape) if mask.any() else mask


def points_hull(handles: NDArray[Any], targets: NDArray[Any], height: int, width: int) -> NDArray[np.bool_]:
    """(height, width) bool: pixels of the convex hull of all points (K, 2), (K, 2); pixel (column, row) covers
    [column, column + 1). Points far outside count as on the nearest edge."""
    from PIL import Image, ImageDraw
    from scipy.spatial import ConvexHull, QhullError

    canvas = Image.new("1", (width, height))
    points = np.concatenate([handles, targets]).astype(np.float64).reshape(-1, 2)
    points = np.unique(np.clip(np.floor(points[np.isfinite(points).all(axis=1)]), 0, (width - 1, height - 1)), axis=0)
    if len(points) == 0:
        return np.zeros((height, width), bool)
    try:
        outline = points[ConvexHull(points).vertices]
    except QhullError:  # all on one line, whose ends come first and last
        outline = points[[0, -1]]
    ImageDraw.Draw(canvas).polygon([(int(x), int(y)) for x, y in outline], fill=1, outline=1)
    return np.asarray(canvas, dtype=bool)


def _large(labels: NDArray[Any]) -> NDArray[np.bool_]:
    return np.bincount(labels.ravel())[labels] >= SMALLEST
