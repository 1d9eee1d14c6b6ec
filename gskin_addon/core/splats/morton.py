# SPDX-License-Identifier: GPL-3.0-or-later
"""Morton curves (Z order): what is near in space becomes near in memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

BITS = 21
"""Of each coordinate of a key: three fit into 64."""

_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_keys(cells: NDArray[Any]) -> NDArray[np.uint64]:
    """Place (N,) on the curve of cells (N, 3), whole numbers from 0 to 2^`BITS` - 1."""
    key = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        c = cells[:, axis].astype(np.uint64)
        for shift, mask in _SPREAD:
            c = (c | (c << np.uint64(shift))) & np.uint64(mask)
        key |= c << np.uint64(axis)
    return key


def morton_order(points: ArrayLike) -> NDArray[np.int64]:
    """Order (N,) of points (N, 3) along a Morton curve through 1024 cells a side: neighbours in space become
    neighbours in memory."""
    p = np.asarray(points, np.float64)
    lower, extent = p.min(axis=0), np.ptp(p, axis=0)
    cells = ((p - lower) / np.maximum(extent.max(), 1e-30) * 1023).astype(np.uint64)
    return np.argsort(morton_keys(cells), kind="stable")
