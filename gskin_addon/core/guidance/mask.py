# SPDX-License-Identifier: GPL-3.0-or-later
"""The dynamic mask (Sec. III-C): where the image may change between rest and pose."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

DIFFERENCE = 0.02
SMALLEST = 6


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


def _large(labels: NDArray[Any]) -> NDArray[np.bool_]:
    return np.bincount(labels.ravel())[labels] >= SMALLEST
