# SPDX-License-Identifier: GPL-3.0-or-later
"""The nearest triangle of a mesh to every point, exactly, in numpy alone (Blender's Python has no scipy).

The triangles with the nearest centres give every point an upper bound; a bounding-volume hierarchy over all triangles,
descended by all points side by side, keeps the (point, box) pairs that can beat it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .nearest_points import nearest_points
from .triangles import closest_barycentric

Array = NDArray[Any]

_WIDTH = 8  # children per box
_CENTRES = 4  # triangles that give the bound
_CHUNK = 20_000
_PAIRS = 3_000_000
_TIE = 1e-9


def nearest_triangles(points: Array, corner: Array) -> tuple[Array, Array]:
    """Index (N,) of the nearest of the triangles (F, 3, 3), and barycentrics (N, 3) of the foot point.

    Where several are equally near (the foot lies on an edge), the one whose normal points best to the point is
    taken, then the first. ValueError for no triangles.
    """
    if len(corner) == 0:
        raise ValueError("there are no triangles to search")
    points = np.asarray(points, dtype=np.float64)
    search = _Search(np.asarray(corner, dtype=np.float64), points)
    index = np.empty(len(points), dtype=np.int64)
    for first in range(0, len(points), _CHUNK):
        index[first : first + _CHUNK] = search.query(points[first : first + _CHUNK])
    return index, closest_barycentric(points, corner[index])


class _Search:
    def __init__(self, corner: Array, points: Array) -> None:
        lower, upper = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
        self.order = _compact_order(corner.mean(axis=1))
        self.corner = corner[self.order]
        normal = np.cross(self.corner[:, 1] - self.corner[:, 0], self.corner[:, 2] - self.corner[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        self.normal = normal / np.where(length > 0, length, 1)
        far = np.concatenate([points, [lower, upper]])
        self.tie = _TIE * float(np.linalg.norm(far.max(axis=0) - far.min(axis=0)))
        self.levels = [(self.corner.min(axis=1), self.corner.max(axis=1))]
        self.centres = self.corner.mean(axis=1)
        while len(self.levels[-1][0]) > _WIDTH:
            low, high = self.levels[-1]
            starts = np.arange(0, len(low), _WIDTH)
            self.levels.append((np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)))

    def query(self, points: Array) -> Array:
        bound = self._bound(points)
        who, box = self._children(len(points))
        for level in range(len(self.levels) - 1, -1, -1):
            near = self._box_distance(level, points[who], box)
            keep = near <= bound[who] + self.tie
            who, box, near = who[keep], box[keep], near[keep]
            if level:
                if len(who) * _WIDTH > _PAIRS and len(points) > 1:
                    half = len(points) // 2
                    return np.concatenate([self.query(points[:half]), self.query(points[half:])])
                who, box = self._expand(level, who, box)
        # The box that looks nearest usually is: its triangle rules most others out.
        lead = np.lexsort((near, who))
        lead = lead[np.concatenate([[True], who[lead][1:] != who[lead][:-1]])]
        bound[who[lead]] = np.minimum(bound[who[lead]], self._distance(points[who[lead]], box[lead])[0])
        keep = near <= bound[who] + self.tie
        who, box = who[keep], box[keep]
        distance, lift = self._distance(points[who], box)
        best = np.full(len(points), np.inf)
        np.minimum.at(best, who, distance)
        tied = distance <= best[who] + self.tie
        who, box, lift = who[tied], box[tied], lift[tied]
        face = self.order[box]
        chosen = np.lexsort((face, -np.round(lift / max(self.tie, 1e-300)), who))
        first = np.concatenate([[True], who[chosen][1:] != who[chosen][:-1]])
        result: Array = face[chosen[first]]
        return result

    def _bound(self, points: Array) -> Array:
        """(N,) distances to a triangle that is nearly the nearest: the best of those whose centres are nearest."""
        index = nearest_points(self.centres, points, min(_CENTRES, len(self.centres)))[1]
        bound = np.full(len(points), np.inf)
        for k in range(index.shape[1]):
            np.minimum(bound, self._distance(points, index[:, k])[0], out=bound)
        return bound

    def _children(self, count: int) -> tuple[Array, Array]:
        top = len(self.levels[-1][0])
        return np.repeat(np.arange(count), top), np.tile(np.arange(top), count)

    def _expand(self, level: int, who: Array, box: Array) -> tuple[Array, Array]:
        below = len(self.levels[level - 1][0])
        child = (box[:, None] * _WIDTH + np.arange(_WIDTH)).ravel()
        real = child < below
        return np.repeat(who, _WIDTH)[real], child[real]

    def _box_distance(self, level: int, points: Array, box: Array) -> Array:
        low, high = self.levels[level]
        gap = np.maximum(np.maximum(low[box] - points, points - high[box]), 0)
        result: Array = np.sqrt(np.einsum("ij,ij->i", gap, gap))
        return result

    def _distance(self, points: Array, box: Array) -> tuple[Array, Array]:
        """Distances (M,) to the triangles, and how much of each lies along the triangle's normal."""
        corner = self.corner[box]
        foot = np.einsum("nk,nkd->nd", closest_barycentric(points, corner), corner)
        offset = points - foot
        return np.linalg.norm(offset, axis=1), np.abs(np.einsum("ij,ij->i", offset, self.normal[box]))


def _compact_order(points: Array) -> Array:
    """An order (F,) in which runs of 2^k points lie close together: halved again and again along the widest side."""
    order = np.arange(len(points))
    size = 1 << max(len(points) - 1, 1).bit_length()
    while size > 1:
        group = np.arange(len(points)) // size
        starts = np.arange(0, len(points), size)
        at = points[order]
        wide = (np.maximum.reduceat(at, starts) - np.minimum.reduceat(at, starts)).argmax(axis=1)
        order = order[np.lexsort((at[np.arange(len(at)), wide[group]], group))]
        size //= 2
    return order
