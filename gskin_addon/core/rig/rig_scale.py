# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether a rig is of another unit than the splats that it shall move, and by which factor.

Two things tell: how large the bones are beside the splats, and how close to splats they lie, measured in the rig's own
size. Joints lie inside a body, a few hundredths of its size below the surface; of a rig that is too small the nearest
splat is far away. The second holds for captures with surroundings, too, which are larger than their rig.
`benchmarks/rig_scale.py` measures it on rigged assets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .segments import bone_segments
from .skeleton import Skeleton

Array = NDArray[np.float64]

UNITS = (1e-3, 0.01, 0.0254, 0.1, 10.0, 1 / 0.0254, 100.0, 1000.0)
"""Factors between units that files are mistaken in: millimetres, centimetres, inches, decimetres; and back."""

FILLED = 0.9
"""Part of the splats' extent that the bones of a sound rig have: their ends lie inside the body."""
ABSURD = 0.2
"""Factor of a rig so much too large that it cannot be right. One that is small may stand in a large captured scene."""
_SMALL, _LARGE = 2.8, 0.4
"""By how much a rig may have to be scaled to be as large as the splats: bones for a tail or a prop may lack, or stick
out."""
_NEAR, _OFF = 0.12, 0.42
"""Distance of four fifths of the bones to the next splat, over the rig's size: fits so closely; cannot fit beyond."""
_BARE = 0.45
"""Distance of nine tenths of the splats to the next bone over their size, from which on bones are missing."""
_CLEAR = 0.6
"""Part of the present misfit that may be left with another unit."""
_ALONE = 0.85
"""Part of the next best unit's misfit that the best may have."""
_FREE = 1.5
"""Part of the misfit of bones that are just as large as the splats, whatever the factor."""
_PER_BONE, _BONE_POINTS, _SPLAT_POINTS = 5, 300, 2500


@dataclass(frozen=True)
class ScaleGuess:
    """factor: by which the rig must be scaled, 1 where its size will do; sure: it is one of `UNITS`, and with it the
    bones lie in the splats; about_world: the place of the armature object must be scaled, too."""

    factor: float = 1.0
    sure: bool = True
    about_world: bool = False

    @property
    def words(self) -> str:
        """As "10 times too small"; "" where the size will do."""
        if self.factor == 1.0:
            return ""
        about = "" if self.sure else "about "
        size = self.factor if self.factor > 1.0 else 1.0 / self.factor
        return f"{about}{size:.3g} times too {'small' if self.factor > 1.0 else 'large'}"


@dataclass(frozen=True)
class _Fit:
    """How bones lie in splats: by what they must be scaled to be as large; distances as `_NEAR` and `_BARE` say."""

    ratio: float
    off: float
    bare: float

    @property
    def misfit(self) -> float:
        return self.off + self.bare


def misfit(points: NDArray[Any], skeleton: Skeleton) -> float:
    """How badly bones lie in splats at `points` (N, 3): distances of bones to splats over the rig's size, plus those of
    splats to bones over their own. A few hundredths where all is well, infinite where one has no size.
    """
    rig, splats = _Bones(skeleton), _Splats(points)
    return _fit(splats, rig.joints, rig.size).misfit if rig.size > 0.0 and splats.extent > 0.0 else float("inf")


def guess_scale(points: NDArray[Any], skeleton: Skeleton, origin: NDArray[Any]) -> ScaleGuess:
    """Whether the bones are too small or too large for splats at `points` (N, 3); both in the world, metres.

    origin: (3,) of the armature object, about which it would be scaled.
    """
    rig, splats = _Bones(skeleton), _Splats(points)
    extent = splats.extent
    if not (rig.size > 0.0 and extent > 0.0):
        return ScaleGuess()

    def fit(factor: float, pivot: Array) -> _Fit:
        return _fit(splats, pivot + factor * (rig.joints - pivot), factor * rig.size)

    here = fit(1.0, np.zeros(3))
    if not _doubtful(here):
        return ScaleGuess()
    pivots = [np.asarray(origin, np.float64)]
    if np.linalg.norm(pivots[0]) > 1e-6 * extent:
        pivots.append(np.zeros(3))
    tried = [(fit(unit, pivot), unit, bool(k)) for k, pivot in enumerate(pivots) for unit in UNITS]
    best, unit, about_world = min(tried, key=lambda one: one[0].misfit)
    rival = min(one[0].misfit for one in tried if one[1] != unit)
    free = min(fit(here.ratio, pivot).misfit for pivot in pivots)
    fits = 0.35 < best.ratio < 3.0 and best.off < _OFF
    if fits and best.misfit < min(_CLEAR * here.misfit, _ALONE * rival, _FREE * free):
        return ScaleGuess(unit, True, about_world)
    return ScaleGuess(here.ratio, False) if here.ratio > _SMALL or here.ratio < _LARGE else ScaleGuess()


def _doubtful(fit: _Fit) -> bool:
    """Whether the size of a rig needs a word."""
    missing = fit.off >= _NEAR or fit.bare >= _BARE
    return fit.ratio < _LARGE or (fit.ratio > _SMALL and missing) or fit.off > _OFF


class _Bones:
    """joints (M, 3): points along the bones; size: of the box of the bones."""

    def __init__(self, skeleton: Skeleton) -> None:
        segments = bone_segments(skeleton)
        ends = np.concatenate([segments.starts, segments.ends])
        self.size = float(np.linalg.norm(np.ptp(ends, axis=0)))
        along = np.linspace(0.0, 1.0, _PER_BONE)[:, None, None]
        points = segments.starts + along * (segments.ends - segments.starts)
        self.joints = _some(points.reshape(-1, 3), _BONE_POINTS)


class _Splats:
    """points (M, 3): some of the splats; extent: of the box of all but the outermost hundredths."""

    def __init__(self, points: NDArray[Any]) -> None:
        low, high = np.percentile(points, [1, 99], axis=0)
        self.extent = float(np.linalg.norm(high - low))
        self.points = _some(np.asarray(points, np.float64), _SPLAT_POINTS)


def _fit(splats: _Splats, joints: Array, size: float) -> _Fit:
    points = splats.points
    square = (points**2).sum(axis=1)[:, None] + (joints**2).sum(axis=1) - 2.0 * points @ joints.T
    distance = np.sqrt(np.maximum(square, 0.0))
    off = float(np.percentile(distance.min(axis=0), 80)) / size
    bare = float(np.percentile(distance.min(axis=1), 90)) / splats.extent
    return _Fit(FILLED * splats.extent / size, off, bare)


def _some(points: Array, count: int) -> Array:
    return points[:: -(-len(points) // count)]
