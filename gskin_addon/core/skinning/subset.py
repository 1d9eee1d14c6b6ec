# SPDX-License-Identifier: GPL-3.0-or-later
"""Large clouds: learn on a part of the splats, then give the rest what their neighbours learned."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..render.cpu import morton_order
from ..splats.cloud import SplatCloud
from .fields.base import LOG_FLOOR

LIMIT = 150_000
NEIGHBOURS = 4
_CHUNK = 250_000


@dataclass(frozen=True)
class SplatSubset:
    """The splats that are optimised: index (M,) into the whole cloud, and the cloud they make."""

    index: NDArray[np.int64]
    cloud: SplatCloud
    whole: SplatCloud

    def spread(
        self,
        learned: NDArray[np.float32],
        initial: NDArray[np.float32],
        initial_whole: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Weights (N, B) of all splats from those of the subset (M, B).

        What was learned is a change of logits that varies smoothly in space, so every other splat adds the
        mean change of its nearest learned neighbours to the logits of its own initial weights.
        """
        out = np.empty_like(initial_whole)
        out[self.index] = learned
        if len(self.index) == self.whole.count:
            return out
        from scipy.spatial import cKDTree

        change = np.log(np.maximum(learned, 1e-8)) - np.log(np.maximum(initial, LOG_FLOOR))
        tree = cKDTree(self.cloud.means)
        rest = np.setdiff1d(np.arange(self.whole.count), self.index)
        for first in range(0, len(rest), _CHUNK):
            part = rest[first : first + _CHUNK]
            distance, near = tree.query(self.whole.means[part], NEIGHBOURS)
            share = 1.0 / np.maximum(distance, 1e-9)
            share = (share / share.sum(1, keepdims=True)).astype(np.float32)
            logits = np.log(np.maximum(initial_whole[part], LOG_FLOOR))
            for k in range(NEIGHBOURS):
                logits += share[:, k : k + 1] * change[near[:, k]]
            logits -= logits.max(axis=1, keepdims=True)
            weights = np.exp(logits)
            out[part] = weights / weights.sum(axis=1, keepdims=True)
        return out


def follow_nearest(
    means: NDArray[np.float32], weights: NDArray[np.float32], ignored: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Weights (N, B) in which the `ignored` splats (N,) move as the nearest of the others does."""
    if not ignored.any():
        return weights
    from scipy.spatial import cKDTree

    others = np.flatnonzero(~ignored)
    near = others[cKDTree(means[others]).query(means[ignored])[1]]
    out = weights.copy()
    out[ignored] = weights[near]
    return out


def choose_subset(
    cloud: SplatCloud, seed: int, limit: int | None = None, *, ignored: NDArray[np.bool_] | None = None
) -> SplatSubset:
    """All splats but the `ignored` (N,), or a random `limit` (`LIMIT`) of them, enlarged so that they still
    cover the surface.

    They come along a Morton curve: what is near in space is near in memory, which the kernels like.
    """
    limit = LIMIT if limit is None else limit
    index = np.arange(cloud.count) if ignored is None else np.flatnonzero(~ignored)
    grow = 1.0
    if len(index) > limit:
        grow = np.sqrt(len(index) / limit)
        index = np.random.default_rng(seed).choice(index, limit, replace=False)
    index = index[morton_order(cloud.means[index])]
    part = cloud.select(index)
    return SplatSubset(index, replace(part, scales=part.scales * np.float32(grow)), cloud)
