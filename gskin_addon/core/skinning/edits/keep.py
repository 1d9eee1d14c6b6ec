# SPDX-License-Identifier: GPL-3.0-or-later
"""What a change of weights leaves alone: splats that are not selected, and locked bones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_CELLS = 4_000_000
"""Weights worked on at a time: bounds the memory."""


def keep(
    before: Array, after: Array, *, selected: Array | None = None, locked: Array | None = None, most: int = 0
) -> Array:
    """`after` for the selected splats and the bones that are not locked, `before` to the bit for all others.

    before, after (N, B) float32, before's rows as they are, after's with any positive sum; selected (N,) bool, all
    where left out; locked (B,) bool, none where left out; most: bones that a changed row keeps, the locked and then
    the strongest, 0 for all. A changed row sums to 1: its open bones share what the locked ones leave. Where `after`
    gives the open bones nothing, or the locked ones leave nothing, the row stays; so does one that `after` has alike.
    """
    before = np.asarray(before, np.float32)
    out = before.copy()
    chosen = np.arange(len(before)) if selected is None else np.flatnonzero(selected)
    fixed = np.zeros(before.shape[1], bool) if locked is None else np.asarray(locked, bool)
    step = max(1, _CELLS // max(1, before.shape[1]))
    for first in range(0, len(chosen), step):
        rows = chosen[first : first + step]
        new = np.maximum(np.asarray(after[rows], np.float32), 0)
        meant = (new != before[rows]).any(axis=1)  # others would change by rounding alone
        new[:, fixed] = 0
        if most:
            _drop_weakest(new, most - (before[np.ix_(rows, fixed)] > 0).sum(axis=1))
        share = np.maximum(1 - before[np.ix_(rows, fixed)].sum(axis=1, dtype=np.float64), 0)
        total = new.sum(axis=1, dtype=np.float64)
        new *= (share / np.where(total > 0, total, 1)).astype(np.float32)[:, None]
        new[:, fixed] = before[np.ix_(rows, fixed)]
        changed = meant & (total > 0) & (share > 0)
        out[rows[changed]] = new[changed]
    return out


def _drop_weakest(rows: Array, most: Array) -> None:
    """Leave only the strongest of each of rows (n, B), as many as most (n,) says."""
    order = np.argsort(-rows, axis=1, kind="stable")
    rank = np.empty_like(order)
    np.put_along_axis(rank, order, np.arange(rows.shape[1])[None], axis=1)
    rows[rank >= most[:, None]] = 0
