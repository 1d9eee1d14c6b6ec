# SPDX-License-Identifier: GPL-3.0-or-later
"""Image pairs as the training loop takes them: in an order that depends on the number of the update only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from ...guidance.lightning_drag.image_tokens import clip_pixels
from ...guidance.lightning_drag.pipeline import to_pixels
from ...guidance.lightning_drag.point_maps import point_maps
from .pairs import Pair, PairDataset

Key = tuple[int, int]
"""(update, place in it): names an example of a training, and all of its randomness."""


@dataclass(frozen=True)
class PairBatch:
    """B examples on the CPU: rest, posed (B, 3, H, W) in [-1, 1]; mask (B, 1, H, W); maps (B, 2, H, W) of the
    points; clip (B, 3, S, S): the rest image for the image encoder; seeds (B,): of their randomness."""

    rest: torch.Tensor
    posed: torch.Tensor
    mask: torch.Tensor
    maps: torch.Tensor
    clip: torch.Tensor
    seeds: list[int]


class Examples(Dataset[Any]):
    """The example of each key. Epochs are permutations that follow each other without a gap."""

    def __init__(self, pairs: PairDataset, size: int, clip_side: int, seed: int) -> None:
        """size: examples of an update, on all devices."""
        self._pairs, self._size, self._clip_side, self._seed = pairs, size, clip_side, seed

    def __getitem__(self, key: Key) -> tuple[Any, ...]:
        update, place = key
        pair = self._pairs[pair_number(len(self._pairs), self._seed, update * self._size + place)]
        stream = np.random.SeedSequence([self._seed, update, place]).generate_state(1, np.uint64)[0]
        return (*tensors(pair, self._clip_side), int(stream >> np.uint64(1)))


def tensors(pair: Pair, clip_side: int) -> tuple[torch.Tensor, ...]:
    """rest, posed, mask, maps, clip of one pair, each with a first axis of 1."""
    rest, posed = pair.rest.astype(np.float32) / 255, pair.posed.astype(np.float32) / 255
    maps = point_maps(pair.handles, pair.targets, *pair.mask.shape)
    return (
        to_pixels(rest),
        to_pixels(posed),
        torch.from_numpy(pair.mask.astype(np.float32))[None, None],
        torch.from_numpy(maps)[None],
        clip_pixels(rest, clip_side),
    )


def pair_number(count: int, seed: int, position: int) -> int:
    """Which of `count` pairs stands at `position` of the endless order."""
    epoch, place = divmod(position, count)
    return int(_order(count, seed, epoch)[place])


@lru_cache(maxsize=2)
def _order(count: int, seed: int, epoch: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, epoch]).permutation(count)


def batches(
    examples: Examples, updates: range, batch: int, accumulate: int, *, process: int, processes: int, workers: int
) -> Iterator[PairBatch]:
    """The batches of one of several processes: `accumulate` for each of `updates`."""
    keys: list[list[Key]] = [
        [(update, (part * processes + process) * batch + k) for k in range(batch)]
        for update in updates
        for part in range(accumulate)
    ]
    loader: DataLoader[Any] = DataLoader(examples, batch_sampler=keys, num_workers=workers, collate_fn=collate)
    yield from loader


def collate(examples: Sequence[tuple[Any, ...]]) -> PairBatch:
    """One batch of several examples."""
    *columns, seeds = zip(*examples, strict=True)
    rest, posed, mask, maps, clip = (torch.cat(column) for column in columns)
    return PairBatch(rest, posed, mask, maps, clip, list(seeds))
