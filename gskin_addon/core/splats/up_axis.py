# SPDX-License-Identifier: GPL-3.0-or-later
"""Which axis of a splat file points up, guessed from what the splats stand on.

Things stand on a broad end: feet, a plinth, a floor (support polygon: Fu et al. 2008, "Upright orientation of
man-made objects"). A confident wrong guess costs an artist more than none, so only tall figures with one end far
broader than any other are taken for sure. `benchmarks/up_axis.py` measures it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cloud import SplatCloud

_SAMPLES = 20_000
_SLABS = (0.015, 0.03)
"""Thickness of the end that is looked at, over the height; all must agree."""
_BROAD = 0.08
"""Least area of what it stands on, over the area of the whole seen from above."""
_BROADER = 2.0
"""Least ratio to the other ends."""
_TALL = 1.9
"""Least ratio of the height to the depth (the other of y and z)."""
_OPAQUE = 0.3
_BINS = 100
_PLANE, _BEYOND, _ABOVE = 0.15, 0.05, 0.2
"""Of the splats: least share of a floor in two bins of its axis, largest beyond it, least that stands on it."""
_WIDE = 0.5
"""Least area of a floor's hull over the area of the whole seen from above."""
_INNER = 0.7
"""Largest spread of what stands on a floor over the floor's own; the legs of a table stand further out than its top."""

_UP_OF_BOTTOM = {"-z": "z", "-y": "y", "y": "-y"}


@dataclass(frozen=True)
class UpGuess:
    """An axis of `UP_AXES`, why, in words that follow a comma, and how sure (0: not at all, 1)."""

    axis: str
    reason: str
    confidence: float

    @property
    def sure(self) -> bool:
        """Whether there was evidence; else the axis is Blender's z."""
        return self.confidence > 0.0

    @property
    def sentence(self) -> str:
        """As "-Y up, it stands on its +Y end"."""
        return f"{self.axis.upper()} up, {self.reason}"


def guess_up(cloud: SplatCloud) -> UpGuess:
    """The up axis of a cloud with the file's own axes; z with confidence 0 where the splats do not tell."""
    unsure = UpGuess("z", "not sure which way is up", 0.0)
    opaque = cloud.means[cloud.opacities >= _OPAQUE]
    points = opaque[:: max(1, len(opaque) // _SAMPLES)].astype(np.float64)
    if len(points) < 100:
        return unsure
    lower, upper = np.percentile(points, [0.5, 99.5], axis=0).astype(np.float64)
    extent = upper - lower
    if extent.min() <= 0.0:
        return unsure
    ends = {end: _supports(points, lower, extent, end) for end in ("-y", "y", "-z", "z")}
    bottom = max(ends, key=lambda end: ends[end][-1])
    axis = "xyz".index(bottom[-1])
    second = np.max([ends[end] for end in ends if end != bottom], axis=0)
    ratio = float(np.min(ends[bottom] / np.maximum(second, 1e-6)))
    tall = extent[axis] / extent[3 - axis]
    if bottom not in _UP_OF_BOTTOM or ends[bottom][-1] < _BROAD or ratio < _BROADER or tall < _TALL:
        planes = {end: _plane(points, lower, extent, end) for end in ("-x", "x", *ends)}
        found = [end for end, plane in planes.items() if plane]
        # Walls and ceilings look like floors.
        if len(found) != 1 or planes[found[0]] != "floor" or found[0] not in _UP_OF_BOTTOM:
            return unsure
        return UpGuess(_UP_OF_BOTTOM[found[0]], f"a floor lies at its {_named(found[0])} end", 1.0)
    return UpGuess(_UP_OF_BOTTOM[bottom], f"it stands on its {_named(bottom)} end", 1.0 - 1.0 / ratio)


def _named(end: str) -> str:
    return (f"+{end}" if len(end) == 1 else end).upper()


def _plane(points: NDArray[np.float64], lower: NDArray[np.float64], extent: NDArray[np.float64], end: str) -> str:
    """What lies at that end of the points: "floor" for a plane in the middle of which something stands, "plane" for
    another one, or a thinner one, "" for none."""
    axis = "xyz".index(end[-1])
    others = [k for k in range(3) if k != axis]
    height = (points[:, axis] - lower[axis]) / extent[axis]
    if len(end) == 1:
        height = 1.0 - height
    counts = np.bincount(np.clip(height * _BINS, 0, _BINS - 1).astype(int), minlength=_BINS)
    pairs = (counts[:-1] + counts[1:]) / len(points)
    beyond = np.cumsum(counts) / len(points) - counts / len(points)
    first = int(np.argmax(np.where(beyond[:-1] <= _BEYOND, pairs, 0.0)))
    if pairs[first] < _PLANE / 2:
        return ""
    flat = points[np.abs(height * _BINS - first - 1.0) < 1.0][:, others]
    low, high = np.percentile(flat, [1, 99], axis=0)
    hull = _hull(flat[np.all((flat >= low) & (flat <= high), axis=1)])
    x, y = hull.T if len(hull) else (np.zeros(1), np.zeros(1))
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))
    if area < _WIDE * float(np.prod(extent[others])):
        return ""
    above = points[height * _BINS > first + 4.0][:, others]
    stands = len(above) >= max(8.0, _ABOVE * len(points)) and (above.std(axis=0) < _INNER * flat.std(axis=0)).all()
    return "floor" if stands and pairs[first] >= _PLANE else "plane"


def _supports(
    points: NDArray[np.float64], lower: NDArray[np.float64], extent: NDArray[np.float64], end: str
) -> NDArray[np.float64]:
    """For each slab, the area of its hull over the area of the bounds; 0 where the centre is not above it."""
    axis = "xyz".index(end[-1])
    others = [k for k in range(3) if k != axis]
    height = (points[:, axis] - lower[axis]) / extent[axis]
    if len(end) == 1:
        height = 1.0 - height
    center = points[(height > 0.0) & (height < 1.0)][:, others].mean(axis=0)
    areas = []
    for slab in _SLABS:
        # Strays lie far below the rest.
        flat = points[(height > -0.05) & (height < slab)][:, others]
        if len(flat) >= 8:
            low, high = np.percentile(flat, [2, 98], axis=0)
            flat = flat[np.all((flat >= low) & (flat <= high), axis=1)]
        hull = _hull(flat)
        edges = np.roll(hull, -1, axis=0) - hull
        to_center = center - hull
        stable = len(hull) >= 3 and bool(np.all(edges[:, 0] * to_center[:, 1] >= edges[:, 1] * to_center[:, 0]))
        x, y = hull.T if len(hull) else (np.zeros(1), np.zeros(1))
        area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))
        # An unstable end still speaks against another one.
        areas.append((area if stable else 0.5 * area) / float(np.prod(extent[others])))
    return np.array(areas)


def _hull(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners (H, 2) of the convex hull, counter-clockwise (Andrew's monotone chain)."""
    ordered = np.unique(points, axis=0)
    if len(ordered) < 3:
        return ordered

    def chain(sequence: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        kept: list[NDArray[np.float64]] = []
        for point in sequence:
            while len(kept) > 1:
                a, b = kept[-1] - kept[-2], point - kept[-2]
                if a[0] * b[1] - a[1] * b[0] > 0.0:
                    break
                kept.pop()
            kept.append(point)
        return kept

    return np.array(chain(ordered)[:-1] + chain(ordered[::-1])[:-1])
