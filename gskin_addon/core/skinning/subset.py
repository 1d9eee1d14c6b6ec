# SPDX-License-Identifier: GPL-3.0-or-later
"""Large clouds: learn on some of the splats, then query the field for the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.nearest_points import nearest_points
from ..splats.cloud import SplatCloud
from ..splats.morton import morton_order
from .fields import LOG_FLOOR
from .walls import nearest_open

LIMIT = 150_000
NEIGHBOURS = 4
HIDDEN = 0.25
"""Factor on the chance of a splat that no view sees at rest: a pose may reveal it."""
LARGEST = 3.0
"""Largest factor by which a splat is enlarged to cover for those left out."""
_CHUNK = 50_000

Query = Callable[[NDArray[Any]], tuple[NDArray[np.float32], NDArray[np.bool_]] | None]
"""See `WeightField.query`."""


@dataclass(frozen=True)
class SplatSubset:
    """The splats that are optimised: index (M,) into the whole cloud, and the cloud they make."""

    index: NDArray[np.int64]
    cloud: SplatCloud
    whole: SplatCloud

    def to_all_splats(
        self,
        learned: NDArray[np.float32],
        initial: NDArray[np.float32],
        initial_whole: NDArray[np.float32],
        query: Query | None = None,
    ) -> NDArray[np.float32]:
        """Weights (N, B) of all splats from those of the subset (M, B).

        What was learned is a change of logits that varies smoothly in space. Every other splat adds the change
        that the field has at its place to the logits of its own initial weights; where the field knows nothing,
        the mean change of its nearest learned neighbours.
        """
        out = np.empty_like(initial_whole)
        out[self.index] = learned
        if len(self.index) == self.whole.count:
            return out
        rest = np.ones(self.whole.count, bool)
        rest[self.index] = False
        others = np.flatnonzero(rest)
        for first in range(0, len(others), _CHUNK):
            part = others[first : first + _CHUNK]
            points = self.whole.means[part]
            found = None if query is None else query(points)
            if found is None:
                found = np.zeros((len(part), out.shape[1]), np.float32), np.zeros(len(part), bool)
            change, known = found
            lost = np.flatnonzero(~known)
            distance, near = nearest_points(self.cloud.means, points[lost], NEIGHBOURS)
            share = 1.0 / np.maximum(distance, 1e-9)
            share = (share / share.sum(1, keepdims=True)).astype(np.float32)
            change[lost] = 0.0
            for k in range(NEIGHBOURS):
                at = near[:, k]
                step = np.log(np.maximum(learned[at], 1e-8)) - np.log(np.maximum(initial[at], LOG_FLOOR))
                change[lost] += share[:, k : k + 1] * step
            logits = np.log(np.maximum(initial_whole[part], LOG_FLOOR)) + change
            logits -= logits.max(axis=1, keepdims=True)
            weights = np.exp(logits)
            out[part] = weights / weights.sum(axis=1, keepdims=True)
        return out


def follow_nearest(
    means: NDArray[np.float32],
    weights: NDArray[np.float32],
    ignored: NDArray[np.bool_],
    walls: NDArray[Any] | None = None,
) -> NDArray[np.float32]:
    """Weights (N, B) in which each `ignored` splat (N,) gets those of the nearest other splat that no wall (N,)
    separates from it; changed in place."""
    if not ignored.any():
        return weights
    others, strays = np.flatnonzero(~ignored), np.flatnonzero(ignored)
    labels, own = (None, None) if walls is None else (walls[others], walls[strays])
    weights[strays] = weights[others[nearest_open(means[others], means[strays], labels, own)[1]]]
    return weights


def choose_subset(
    cloud: SplatCloud,
    seed: int,
    limit: int | None = None,
    *,
    ignored: NDArray[np.bool_] | None = None,
    visible: Callable[[], NDArray[Any]] | None = None,
) -> SplatSubset:
    """All splats but the `ignored` (N,), or about `limit` (default `LIMIT`) that represent them.

    A splat is taken with a probability proportional to the root of its opacity times its area, and less if `visible`
    (called if needed; (N,) True for those that show in some view) says that it is hidden. It is enlarged by the root of
    1 / probability, so that the surface stays covered. Splats are drawn at even steps along a Morton curve, which
    distributes them evenly, and keep its order: neighbours in space are neighbours in memory, for the kernels' cache.
    """
    limit = LIMIT if limit is None else limit
    index = np.arange(cloud.count) if ignored is None else np.flatnonzero(~ignored)
    index = index[morton_order(cloud.means[index])]
    if len(index) <= limit:
        return SplatSubset(index, cloud.select(index), cloud)
    ordered = np.sort(cloud.scales[index].astype(np.float64), axis=1)
    value = np.sqrt(ordered[:, 1] * ordered[:, 2] * cloud.opacities[index]) + 1e-12
    if visible is not None:
        value *= np.where(np.asarray(visible())[index], 1.0, HIDDEN)
    chance = inclusion(value, limit)
    ends = np.cumsum(chance)
    steps = np.random.default_rng(seed).random() + np.arange(int(ends[-1] + 0.5))
    taken = np.unique(np.searchsorted(ends, steps[steps < ends[-1]], side="right"))
    part = cloud.select(index[taken])
    grow = np.minimum(1.0 / np.sqrt(chance[taken]), LARGEST).astype(np.float32)
    return SplatSubset(index[taken], replace(part, scales=part.scales * grow[:, None], stored={}), cloud)


def inclusion(value: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Probabilities (N,) in proportion to `value` (N,), none above 1, with the sum `count` < N."""
    certain = np.zeros(len(value), bool)
    while True:
        rest = count - certain.sum()
        chance = np.where(certain, 1.0, value * (rest / value[~certain].sum()))
        over = chance > 1.0
        if not over.any():
            return chance
        certain |= over
