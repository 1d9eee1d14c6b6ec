# SPDX-License-Identifier: GPL-3.0-or-later
"""Few values that stand for many: codebooks of numbers, and palettes of vectors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cloud import FloatArray
from .loaded import pieces

SIZE = 256
"""Values of a codebook."""

_SAMPLES = 1 << 20
_COARSE = 256
_TRAINED_ON = 64
"""Vectors per palette entry, at most, that a palette is fitted to."""
_ROUNDS = 4


def codebook(values: NDArray[Any]) -> FloatArray:
    """SIZE rising numbers (SIZE,) for values of any shape: the values themselves where they are few; else half of the
    entries evenly over the range, which bounds every error by a 254th of it, and half where most values are.
    """
    flat = np.asarray(values, np.float32).reshape(-1)
    sample = flat[:: max(1, flat.size // _SAMPLES)]
    found = np.unique(sample)
    if len(found) <= SIZE and sample.size < flat.size:
        found = np.unique(flat)
    if len(found) <= SIZE:
        return np.concatenate([found, np.full(SIZE - len(found), found[-1], np.float32)])
    even = np.linspace(flat.min(), flat.max(), SIZE // 2, dtype=np.float64)
    dense = np.quantile(sample, (np.arange(SIZE // 2) + 0.5) / (SIZE // 2))
    return np.sort(np.concatenate([even, dense])).astype(np.float32)


def nearest_entry(book: FloatArray, values: NDArray[Any]) -> NDArray[np.uint8]:
    """Place of the entry of a rising codebook that is nearest to each value; the shape of the values."""
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2.0
    return np.searchsorted(middles, values).astype(np.uint8)


def palette(vectors: FloatArray, size: int, seed: int = 0) -> tuple[FloatArray, NDArray[np.int64]]:
    """At most `size` vectors (P, D) for vectors (N, D), and the entry of each (N,); exact where N <= size.

    k-means in two levels (coarse cells, then entries within each), so that 65,536 entries for a million vectors of 45
    numbers take seconds.
    """
    count = len(vectors)
    if count <= size:
        return vectors.copy(), np.arange(count)
    rng = np.random.default_rng(seed)
    coarse = min(_COARSE, max(1, int(size**0.5)))
    sample = vectors[np.sort(rng.choice(count, min(count, _TRAINED_ON * coarse), replace=False))]
    cells, _ = _k_means(sample, coarse, rng)
    cell = _nearest(vectors, cells)
    order = np.argsort(cell, kind="stable")
    ends = np.cumsum(np.bincount(cell, minlength=len(cells)))
    entries: list[FloatArray] = []
    label = np.empty(count, np.int64)
    used = 0
    for first, last in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
        rows = order[first:last]
        if not len(rows):
            continue
        share = max(1, int(size * len(rows) / count) - (len(rows) < count / size))
        share = min(share, len(rows), size - used - (len(ends) - len(entries) - 1))
        inside, places = _k_means(vectors[rows], max(1, share), rng)
        label[rows] = used + places
        entries.append(inside)
        used += len(inside)
    return np.concatenate(entries), label


def _k_means(vectors: FloatArray, size: int, rng: np.random.Generator) -> tuple[FloatArray, NDArray[np.int64]]:
    """Lloyd's algorithm from `size` of the vectors; the means that have members, and each vector's (N,)."""
    means = vectors[np.sort(rng.choice(len(vectors), min(size, len(vectors)), replace=False))].astype(np.float32)
    label = _nearest(vectors, means)
    for _ in range(_ROUNDS):
        order = np.argsort(label, kind="stable")
        starts = np.flatnonzero(np.diff(label[order], prepend=-1))
        sums = np.add.reduceat(vectors[order], starts, axis=0, dtype=np.float64)
        means = (sums / np.diff(starts, append=len(label))[:, None]).astype(np.float32)
        label = _nearest(vectors, means)
    return means, label


def _nearest(vectors: FloatArray, means: FloatArray) -> NDArray[np.int64]:
    """The nearest of the means (K, D) to each vector (N, D)."""
    label = np.empty(len(vectors), np.int64)
    half = 0.5 * np.einsum("kd,kd->k", means, means)
    for rows in pieces(len(vectors)):
        label[rows] = (vectors[rows] @ means.T - half).argmax(axis=1)
    return label
