# SPDX-License-Identifier: GPL-3.0-or-later
"""The few strongest bones of every splat: weights that take a tenth of the room of a row for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .lbs import top_influences

INFLUENCES = 4
"""Bones kept of each splat."""


@dataclass(frozen=True, eq=False)
class Influences:
    """index (N, K) int32: bones; value (N, K) float32: their weights, rows sum to 1; a slot of weight 0 is empty."""

    index: NDArray[np.int32]
    value: NDArray[np.float32]

    @classmethod
    def strongest(cls, weights: NDArray[Any], k: int = INFLUENCES) -> Influences:
        """The `k` strongest of weights (N, B), normalised; fewer where there are fewer bones."""
        index, value = top_influences(weights, k)
        return cls(index.astype(np.int32), value.astype(np.float32))

    @classmethod
    def joined(cls, parts: Sequence[Influences]) -> Influences:
        """Those of several clouds, one after the other."""
        return cls(np.concatenate([part.index for part in parts]), np.concatenate([part.value for part in parts]))

    def rows(self, choice: NDArray[Any]) -> Influences:
        """Those of the splats `choice` (M,), indices."""
        return Influences(self.index[choice], self.value[choice])

    def dense(self, bones: int) -> NDArray[np.float32]:
        """The same as weights (N, B)."""
        out = np.zeros((len(self.index), bones), np.float32)
        # Added, not put: an empty slot may name a bone that another slot has.
        np.add.at(out, (np.arange(len(out))[:, None], self.index), self.value)
        return out

    def fault(self, count: int, bones: int) -> str:
        """What is wrong with them for `count` splats and `bones` bones; empty where nothing is."""
        index, value = self.index, self.value
        if index.ndim != 2 or index.shape != value.shape or len(index) != count or not index.shape[1]:
            return f"arrays {index.shape} and {value.shape} for {count} splats"
        if index.dtype.kind not in "iu" or value.dtype.kind != "f":
            return f"arrays of {index.dtype} and {value.dtype}"
        if count and not 0 <= int(index.min()) <= int(index.max()) < bones:
            return f"bones outside of 0..{bones - 1}"
        if not np.isfinite(value).all() or (value < 0).any():
            return "weights that are negative or not finite"
        if count and float(np.abs(value.sum(axis=1, dtype=np.float64) - 1.0).max()) > 1e-3:
            return "rows that do not sum to 1"
        return ""
