# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats that deform badly: strays off the body, faint giants, needles. numpy only, as Blender's side uses it.

Nothing here removes splats: the finders return masks (N,), True where a splat is bad; the shapers return a new
cloud of as many splats in the same order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .cloud import SplatCloud
from .components import connected_components

Mask = NDArray[np.bool_]

GAP = 0.02
GIANT, FAINT = 0.04, 0.15


def find_strays(
    cloud: SplatCloud, *, gap: float = GAP, share: float = 0.005, crowd: int = 4
) -> Mask:
    """(N,) True for splats off the body: alone, or in a small cluster with nothing around it.

    DBSCAN on a grid (Ester et al. 1996): cells with sides of `gap` x the diagonal; a cell with at least
    `crowd` splats in itself and the 26 cells around it belongs to a cluster with all such neighbours.
    A cluster with less than `share` of the splats is stray (never the largest), and so is what touches none
    that stays. In clouds of few splats the cells grow with the distance between splats.
    """
    if cloud.count == 0:
        return np.zeros(0, bool)
    cell = _diagonal(cloud.means) * max(gap, 2.0 / np.sqrt(cloud.count))
    place = np.floor((cloud.means - cloud.means.min(axis=0)) / cell).astype(np.int64) + 1
    # One empty layer on every side keeps the neighbours of different rows apart.
    size = place.max(axis=0) + 2
    keys, member, number = np.unique(
        (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2], return_inverse=True, return_counts=True
    )
    first, second = _adjacent_cells(keys, size)
    around = number + np.bincount(first, number[second], len(keys)) + np.bincount(second, number[first], len(keys))
    dense = around >= crowd
    linked = dense[first] & dense[second]
    label = connected_components(len(keys), first[linked], second[linked])
    amount = np.bincount(label[dense], number[dense], len(keys))
    kept = dense & (amount[label] >= min(share * cloud.count, amount.max()))
    if not kept.any():  # so few splats that none has company
        return np.zeros(cloud.count, bool)
    reached = kept.copy()
    reached[first[kept[second]]] = True
    reached[second[kept[first]]] = True
    # A sparse cell beside the body is its fringe; a dense one that was not kept is a cluster of its own.
    strays: Mask = ~(kept | (reached & ~dense))[member]
    return strays


def find_faint_giants(cloud: SplatCloud, *, size: float = GIANT, opacity: float = FAINT) -> Mask:
    """(N,) True where the largest scale is over `size` x the diagonal and the opacity under `opacity`.

    Such splats are haze that training put into a scene; they cover many bones, and following the mean of them
    they sweep over the picture.
    """
    if cloud.count == 0:
        return np.zeros(0, bool)
    giants: Mask = (cloud.scales.max(axis=1) > size * _diagonal(cloud.means)) & (cloud.opacities < opacity)
    return giants


def find_needles(cloud: SplatCloud, max_ratio: float) -> Mask:
    """(N,) True where the longest axis is over `max_ratio` x the middle one; flat discs are no needles."""
    ordered = np.sort(cloud.scales, axis=1)
    needles: Mask = ordered[:, 2] > max_ratio * ordered[:, 1] * (1 + 1e-6)
    return needles


def clamp_aspect(cloud: SplatCloud, max_ratio: float) -> tuple[SplatCloud, Mask]:
    """Needles shortened and widened to longest : middle axis = `max_ratio`; also which splats were (N,).

    The product of the two stays, and so does the area that the splat covers seen from its thin side; the third
    axis stays as it is. A needle without any width becomes a disc of its own thickness only in the limit: its
    middle axis counts as at least 1e-4 of the longest.
    """
    if max_ratio < 1:
        raise InputError(f"The largest aspect ratio is {max_ratio}; it must be at least 1.")
    needles = find_needles(cloud, max_ratio)
    if not needles.any():
        return cloud, needles
    scales = cloud.scales.astype(np.float64)
    row = np.flatnonzero(needles)
    axis = np.argsort(scales[row], axis=1)
    longest, middle = scales[row, axis[:, 2]], scales[row, axis[:, 1]]
    area = longest * np.maximum(middle, 1e-4 * longest)
    scales[row, axis[:, 2]] = np.sqrt(area * max_ratio)
    scales[row, axis[:, 1]] = np.sqrt(area / max_ratio)
    return replace(cloud, scales=scales.astype(np.float32), stored=_without_scales(cloud)), needles


def isotropic(cloud: SplatCloud) -> SplatCloud:
    """Every splat as a ball, which no deformation can turn wrongly.

    The radius is the geometric mean of the two larger axes: splats lie flat on surfaces, so this keeps the area
    they cover (keeping the volume would shrink flat ones to nothing). Rotations become the identity.
    """
    ordered = np.sort(cloud.scales.astype(np.float64), axis=1)
    radius = np.sqrt(ordered[:, 2] * ordered[:, 1])
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (cloud.count, 1))
    stored = {name: column for name, column in _without_scales(cloud).items() if not name.startswith("rot")}
    scales = np.repeat(radius.astype(np.float32)[:, None], 3, axis=1)
    return replace(cloud, scales=scales, quats=quats, stored=stored)


@dataclass(frozen=True)
class Cleanup:
    """What to do with bad splats before skinning. In jobs and reports its key is "hygiene".

    ignore_strays, ignore_faint_giants: learn without them; they get the weights of the nearest other splat.
    max_aspect: learn with needles clamped to it, 0 for as they are; isotropic: learn with balls.
    """

    ignore_strays: bool = True
    ignore_faint_giants: bool = True
    max_aspect: float = 0.0
    isotropic: bool = False

    @classmethod
    def parse(cls, values: Mapping[str, Any]) -> Cleanup:
        """From a job's table. Raises InputError: an unknown name, or a value that is not allowed."""
        known = [f.name for f in fields(cls)]
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise InputError(f"The job's hygiene has no option {', '.join(unknown)}; it has {', '.join(known)}.")
        found = cls(**values)
        for name in ("ignore_strays", "ignore_faint_giants", "isotropic"):
            if not isinstance(getattr(found, name), bool):
                raise InputError(f"The job's hygiene option {name} is {getattr(found, name)!r}; use true or false.")
        aspect = found.max_aspect
        if isinstance(aspect, bool) or not isinstance(aspect, int | float) or not (aspect == 0 or aspect >= 1):
            raise InputError(f"The job's hygiene option max_aspect is {aspect!r}; use 0, or a number from 1 up.")
        return found

    def find(self, cloud: SplatCloud) -> tuple[Mask, dict[str, int]]:
        """The splats to ignore (N,), and how many there are of each kind. Never all of them."""
        bad, counts = np.zeros(cloud.count, bool), {}
        for name, wanted, finder in (
            ("strays", self.ignore_strays, find_strays),
            ("faint_giants", self.ignore_faint_giants, find_faint_giants),
        ):
            if wanted:
                mask = finder(cloud)
                counts[name] = int(mask.sum())
                bad |= mask
        return (bad if not bad.all() else np.zeros(cloud.count, bool)), counts

    def shape(self, cloud: SplatCloud) -> tuple[SplatCloud, dict[str, int]]:
        """The cloud to learn with, and how many needles were clamped."""
        counts = {}
        if self.max_aspect:
            cloud, needles = clamp_aspect(cloud, self.max_aspect)
            counts["needles"] = int(needles.sum())
        return (isotropic(cloud) if self.isotropic else cloud), counts


def _diagonal(means: NDArray[Any]) -> float:
    """Diagonal of the box that holds the bulk of the points; strays must not set the measure for strays."""
    low, high = np.percentile(means, [1, 99], axis=0)
    return float(np.linalg.norm(high - low)) or 1.0


def _without_scales(cloud: SplatCloud) -> dict[str, Any]:
    return {name: column for name, column in cloud.stored.items() if not name.startswith("scale")}


def _adjacent_cells(keys: NDArray[np.int64], size: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of indices into the sorted `keys` of occupied cells that touch, each pair once."""
    pairs = []
    for x, y, z in np.ndindex(3, 3, 3):
        step = ((x - 1) * size[1] + (y - 1)) * size[2] + (z - 1)
        if step > 0:
            at = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
            first = np.flatnonzero(keys[at] == keys + step)
            pairs.append((first, at[first]))
    return np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
