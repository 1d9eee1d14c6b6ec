# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures with depth and with what hides splats, by a numba kernel: `fragments.draw`, faster.

The learning kernels (`blend.py`) know nothing of either. Here each thread blends rows of its own, splat by splat.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..camera import Camera, look_at
from ..fragments import ALPHA_CUT, ALPHA_MAX, T_MIN, flatten
from ..picture import Picture
from .compiled import is_compiled
from .threads import parallel_for, row_ranges, thread_count

Floats = NDArray[np.floating[Any]]

COLUMNS = ("a", "b", "c", "k", "x", "y", "depth")
BOX = ("left", "right", "top", "bottom")
LOG_CUT = float(np.log(ALPHA_CUT))


def draw(
    means: Floats,
    quats: Floats,
    scales: Floats,
    colors: Floats,
    opacities: Floats,
    camera: Camera,
    limit: Floats | None = None,
) -> Picture:
    """See `fragments.draw`."""
    height, width = camera.size
    flat = flatten(means, quats, scales, opacities, camera)
    record = np.stack([flat[name] for name in COLUMNS], axis=1).astype(np.float64)
    box = np.stack([flat[name] for name in BOX], axis=1).astype(np.int32)
    tint = np.ascontiguousarray(np.asarray(colors, np.float32)[flat["splat"]])
    far = np.full((height, width), np.inf, np.float32) if limit is None else np.ascontiguousarray(limit, np.float32)
    color = np.zeros((height, width, 3), np.float32)
    T = np.ones((height, width), np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    bands = row_ranges(height, min(height, 4 * thread_count()))
    parallel_for(_blend_rows, bands, record, box, tint, far, color, T, depth)
    return Picture(color, 1.0 - T, depth)


def has_to_compile() -> bool:
    """Whether the first picture waits until the kernel is compiled."""
    return not is_compiled(_blend_rows)


def compile_kernel() -> None:
    """Draw one splat: compiles the kernel, or loads it from the user's cache."""
    camera = look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), size=8)
    draw(np.zeros((1, 3)), np.eye(1, 4), np.full((1, 3), 0.1), np.ones((1, 3)), np.ones(1), camera)


@njit(cache=True, nogil=True)
def _blend_rows(
    lo: Any, hi: Any, record: Any, box: Any, tint: Any, far: Any, color: Any, T: Any, depth: Any
) -> None:  # fmt: skip
    """Blend the splats, near to far, into the rows lo..hi of color (H,W,3), T (H,W) and depth (H,W)."""
    width = T.shape[1]
    ended = np.zeros((hi - lo, width), np.bool_)
    left_open = (hi - lo) * width
    for i in range(record.shape[0]):
        if left_open == 0:
            break
        first: Any = max(np.int64(box[i, 2]), lo)
        last: Any = min(np.int64(box[i, 3]) + 1, hi)
        a, b, c, k = record[i, 0], record[i, 1], record[i, 2], record[i, 3]
        z = np.float32(record[i, 6])
        for row in range(first, last):
            dy = row + 0.5 - record[i, 5]
            peak = k - 0.5 * (c - b * b / a) * dy * dy
            if peak < LOG_CUT:
                continue
            middle = record[i, 4] - b / a * dy - 0.5
            half = np.sqrt(max(2.0 * (peak - LOG_CUT), 0.0) / a)
            begin: Any = max(np.int64(np.ceil(middle - half)), 0)
            end: Any = min(np.int64(np.floor(middle + half)) + 1, width)
            for column in range(begin, end):
                if ended[row - lo, column] or not z <= far[row, column]:
                    continue
                away = column - middle
                alpha = np.float32(min(np.exp(peak - 0.5 * a * away * away), ALPHA_MAX))
                before = T[row, column]
                after = before * (np.float32(1.0) - alpha)
                if after <= T_MIN:
                    ended[row - lo, column] = True
                    left_open -= 1
                    continue
                weight = before * alpha
                for channel in range(3):
                    color[row, column, channel] += weight * tint[i, channel]
                T[row, column] = after
                if before > 0.5 and after <= 0.5:
                    depth[row, column] = z
