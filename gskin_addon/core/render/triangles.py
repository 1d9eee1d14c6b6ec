# SPDX-License-Identifier: GPL-3.0-or-later
"""How far away a mesh is at each pixel: triangles drawn into a depth buffer, in numpy alone.

What a splat has to stand before to be seen. A pixel takes the depth at its centre, so edges are right to a pixel.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .camera import Camera

Floats = NDArray[np.floating[Any]]

RUN = 2_000_000
"""Pixels written at once; about 60 bytes each."""


def depth_of_triangles(corners: Floats, camera: Camera) -> NDArray[np.float32]:
    """Depth (H,W) in metres along the camera's z of the nearest of the triangles `corners` (T,3,3), world; inf beside.

    Both sides hide. What lies nearer than `camera.near` is cut off there.
    """
    height, width = camera.size
    buffer = np.full(height * width, np.inf, np.float32)
    points = camera.to_camera(np.asarray(corners, np.float64).reshape(-1, 3)).reshape(-1, 3, 3)
    points = _clipped(points[np.isfinite(points).all((1, 2))], camera.near)
    z = points[..., 2]
    far = np.ones_like(z) if camera.orthographic else z
    x, y = camera.fx * points[..., 0] / far + camera.cx, camera.fy * points[..., 1] / far + camera.cy
    top = np.maximum(np.ceil(y.min(1) - 0.5), 0)
    bottom = np.minimum(np.floor(y.max(1) - 0.5), height - 1)
    shows = (top <= bottom) & (x.max(1) >= 0.5) & (x.min(1) <= width - 0.5)
    x, y, z, top = x[shows], y[shows], z[shows], top[shows].astype(np.int64)
    rows = bottom[shows].astype(np.int64) - top + 1
    across = np.clip(x.max(1), 0, width) - np.clip(x.min(1), 0, width) + 2
    run = np.cumsum(np.minimum(rows * across, RUN)) // RUN
    cuts = np.flatnonzero(np.r_[True, run[1:] != run[:-1], True]) if len(run) else np.zeros(0, np.int64)
    for first, last in pairwise(cuts.tolist()):
        part = slice(first, last)
        _draw(buffer, width, x[part], y[part], z[part], top[part], rows[part], camera.orthographic)
    return buffer.reshape(height, width)


def _draw(
    buffer: NDArray[np.float32], width: int, x: Floats, y: Floats, z: Floats, top: Any, rows: Any, straight: bool
) -> None:
    """Write the triangles' depths into the buffer (H W,), row by row."""
    triangle = np.repeat(np.arange(len(rows)), rows)
    row = top[triangle] + np.arange(len(triangle)) - np.repeat(np.cumsum(rows) - rows, rows)
    level = row + 0.5
    # Where the row meets the three edges; the span lies between the outermost two.
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        ya, yb = y[triangle, start], y[triangle, end]
        xa, xb = x[triangle, start], x[triangle, end]
        meets = (np.minimum(ya, yb) <= level) & (level <= np.maximum(ya, yb))
        rise = np.where(ya == yb, 1.0, yb - ya)
        here = xa + (level - ya) / rise * (xb - xa)
        left, right = np.where(meets, np.minimum(left, here), left), np.where(meets, np.maximum(right, here), right)
    first, last = np.clip(np.ceil(left - 0.5), 0, width), np.clip(np.floor(right - 0.5), -1, width - 1)
    count = np.maximum(last - first + 1, 0).astype(np.int64)
    span = np.repeat(np.arange(len(count)), count)
    column = first[span].astype(np.int64) + np.arange(len(span)) - np.repeat(np.cumsum(count) - count, count)
    # 1 / z is linear on the image of a plane, z itself where rays are parallel.
    value = z if straight else 1.0 / z
    ax, ay = x[:, 1] - x[:, 0], y[:, 1] - y[:, 0]
    bx, by = x[:, 2] - x[:, 0], y[:, 2] - y[:, 0]
    area: Floats = ax * by - ay * bx
    flat = np.abs(area) < 1e-12
    area = np.where(flat, 1.0, area)
    da, db = value[:, 1] - value[:, 0], value[:, 2] - value[:, 0]
    slope_x = np.where(flat, 0.0, (da * by - db * ay) / area)
    slope_y = np.where(flat, 0.0, (db * ax - da * bx) / area)
    of = triangle[span]
    depth = value[of, 0] + slope_x[of] * (column + 0.5 - x[of, 0]) + slope_y[of] * (level[span] - y[of, 0])
    # Rounding may leave the triangle's own range where it is seen edge-on.
    depth = np.clip(depth, value.min(1)[of], value.max(1)[of])
    np.minimum.at(buffer, row[span] * width + column, (depth if straight else 1.0 / depth).astype(np.float32))


def _clipped(points: Floats, near: float) -> Floats:
    """Triangles (T,3,3) in camera axes without what lies before the plane z = near."""
    inside = points[..., 2] > near
    count = inside.sum(1)
    whole = points[count == 3]
    cut: list[tuple[Floats, Floats, Floats]] = []
    for wanted in (1, 2):
        some = points[count == wanted]
        # Turn each so that its odd corner comes first.
        odd = np.argmax(inside[count == wanted] == (wanted == 1), axis=1)
        a, b, c = (some[np.arange(len(some)), (odd + k) % 3] for k in range(3))
        ab, ac = _meet(a, b, near), _meet(a, c, near)
        cut += [(a, ab, ac)] if wanted == 1 else [(ab, b, c), (ab, c, ac)]
    return np.concatenate([whole, *(np.stack(corners, 1) for corners in cut)])


def _meet(a: Floats, b: Floats, near: float) -> Floats:
    """Where the edges a b (K,3) meet z = near."""
    share = (near - a[:, 2]) / np.where(a[:, 2] == b[:, 2], 1.0, b[:, 2] - a[:, 2])
    met = a + share[:, None] * (b - a)
    met[:, 2] = near
    return np.asarray(met)
