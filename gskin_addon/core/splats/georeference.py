# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats far from the origin, as geo-referenced ones are: near it for us, with the way back.

float32 has 24 binary digits: at 5,400,000 (metres, northing) its steps are half a metre. Centres are therefore read
in double precision and moved by a whole number of units wherever steps of float32 would be seen; the cloud keeps by
how much. What a file itself has rounded away cannot be brought back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .cloud import Floats, SplatCloud

_SEEN = 0.02
"""A step of float32 over the splat's size from which on it counts."""
_COARSE = 0.2
"""From where on what the file has rounded is worth a word."""
_SHARE = 0.01
"""Share of the splats that must be concerned: strays lie anywhere."""
_SAMPLES = 20_000


def recentre(cloud: SplatCloud, doubles: Sequence[NDArray[np.float64] | None], path: Path) -> SplatCloud:
    """The cloud, moved (in place) to where float32 holds its centres; says so in its notes.

    doubles: x, y and z (N,) as the file has them in double precision, None where the centres are all that it has.
    Splats that are not finite are left to whoever counts invalid ones.

    Raises:
        InputError: the file, or float32 after the move, has lost the places of splats among each other.
    """
    rows = slice(None, None, max(1, cloud.count // _SAMPLES))
    columns = [cloud.means[:, k] if column is None else column for k, column in enumerate(doubles)]
    points = np.stack([column[rows].astype(np.float64) for column in columns], axis=1)
    good = np.isfinite(points).all(axis=1) & np.isfinite(cloud.scales[rows]).all(axis=1)
    if not good.any():
        return cloud
    points = points[good]
    sizes = _sizes(points, cloud.scales[rows][good])
    rounded = np.array([column is None for column in doubles])
    if (_concerned(points, sizes, 1.0) & rounded).any():
        raise InputError(
            f"'{path}' has float coordinates, which {_far(points)} from the origin have steps of {_step(points):.2g}, "
            "larger than its splats; export it with double coordinates, or nearer to the origin."
        )
    offset, notes = _offset(points, sizes), list(cloud.notes)
    if _concerned(points - offset, sizes, 1.0).any() or _merged(points - offset) > _SHARE:
        raise InputError(
            f"'{path}' reaches {_far(points - offset)} from its middle, where float has steps of "
            f"{_step(points - offset):.2g}, larger than its splats; crop it to the part that you need."
        )
    if (_concerned(points, sizes, _COARSE) & rounded).any():
        notes.append(f"its coordinates are float, rounded to steps of {_step(points):.2g} so far from the origin")
    if offset.any():
        with np.errstate(over="ignore", invalid="ignore"):
            for k in np.flatnonzero(offset):
                cloud.means[:, k] = columns[k].astype(np.float64) - offset[k]
        step = ", ".join(f"{0.0 - value:.12g}" for value in offset)
        notes.append(f"moved by ({step}) to the origin, which .ply output undoes")
    return replace(cloud, offset=offset, notes=tuple(notes))


def _sizes(points: Floats, scales: Floats) -> NDArray[np.float64]:
    """(N,) the largest scale of each splat; for specks, what part of the mean distance between splats they may move."""
    low, high = np.percentile(points, [1, 99], axis=0)
    spacing = float(np.linalg.norm(high - low)) / len(points) ** 0.5
    return np.maximum(scales.max(axis=1).astype(np.float64), 0.1 * spacing)


def _concerned(points: Floats, sizes: NDArray[np.float64], part: float) -> NDArray[np.bool_]:
    """(3,) True for axes along which enough splats have steps of float32 over `part` x their size."""
    with np.errstate(over="ignore"):
        steps = np.spacing(np.abs(points).astype(np.float32))
    found: NDArray[np.bool_] = (steps > part * sizes[:, None]).mean(axis=0) > _SHARE
    return found


def _merged(points: NDArray[np.float64]) -> float:
    """Share (0 to 1) of the points that float32 puts on another point from which they were apart."""
    single = points.astype(np.float32)
    if len(np.unique(single[:, 0])) == len(points):
        return 0.0
    return (len(np.unique(points, axis=0)) - len(np.unique(single, axis=0))) / len(points)


def _offset(points: Floats, sizes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) whole numbers (of a power of two, in small clouds) to take off; zeros where no axis needs it."""
    low, middle, high = np.percentile(points, [1, 50, 99], axis=0).astype(np.float64)
    extent = float((high - low).max())
    unit = 1.0 if not 0.0 < extent < 1.0 else 2.0 ** np.floor(np.log2(extent))
    outside = np.abs(middle) > 0.5 * (high - low)
    if not (_concerned(points, sizes, _SEEN) & outside).any():
        return np.zeros(3)
    return np.where(outside, np.round(middle / unit) * unit, 0.0) + 0.0


def _far(points: Floats) -> str:
    return f"{float(np.median(np.abs(points).max(axis=1))):,.0f}"


def _step(points: Floats) -> float:
    return float(np.median(np.spacing(np.abs(points).max(axis=1).astype(np.float32))))
