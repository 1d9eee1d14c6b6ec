# SPDX-License-Identifier: GPL-3.0-or-later
"""Which splats an artist means: by colour, along the body, as seen from somewhere, by what they follow."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...splats.components import connected_components
from .body_graph import BodyGraph, along_body

Array = NDArray[Any]
Mask = NDArray[np.bool_]


def oklab(srgb: ArrayLike) -> Array:
    """Lightness, green to red and blue to yellow (N, 3) of sRGB colours (N, 3), 0 to 1: equal distances look alike.

    Oklab (Ottosson 2020), on linear light.
    """
    encoded = np.clip(np.asarray(srgb, np.float64), 0, 1)
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    cones = linear @ np.array([
        [0.4122214708, 0.2119034982, 0.0883024619],
        [0.5363325363, 0.6806995451, 0.2817188376],
        [0.0514459929, 0.1073969566, 0.6299787005],
    ])  # fmt: skip
    return np.asarray(np.cbrt(cones) @ np.array([
        [0.2104542553, 1.9779984951, 0.0259040371],
        [0.7936177850, -2.4285922050, 0.7827717662],
        [-0.0040720468, 0.4505937099, -0.8086757660],
    ]))  # fmt: skip


def by_color(colors: ArrayLike, wanted: ArrayLike, tolerance: float) -> Mask:
    """Mask (N,) of sRGB colours (N, 3) within `tolerance` of the colour `wanted` (3,) in Oklab, where 0.02 is just
    seen and 1 lies between black and white."""
    away = np.linalg.norm(oklab(colors) - oklab(np.asarray(wanted)[None]), axis=1)
    return np.asarray(away <= tolerance)


def spacing(graph: BodyGraph) -> float:
    """The usual way, in metres, from a splat to the one beside it; 0 where no splat has a neighbour."""
    nearest = graph.length[:, 0] if graph.length.shape[1] else graph.length[:, :0].ravel()
    nearest = nearest[np.isfinite(nearest)]
    return float(np.median(nearest)) if len(nearest) else 0.0


def grown(graph: BodyGraph, selected: Mask, distance: float) -> Mask:
    """Mask (N,) of the selected splats and all within `distance` metres of them along the body."""
    return np.asarray(along_body(graph, selected, distance) <= distance)


def shrunk(graph: BodyGraph, selected: Mask, distance: float) -> Mask:
    """Mask (N,) of the selected splats that are farther than `distance` metres from all others along the body."""
    return np.asarray(selected & ~grown(graph, ~selected, distance))


def pieces(graph: BodyGraph, mask: Mask) -> Array:
    """(N,) int64: the connected piece of the splats of `mask` (N,) that each belongs to, from 0 on; -1 for others."""
    count, k = graph.neighbour.shape
    source = np.repeat(np.arange(count), k)[graph.linked.ravel()]
    target = graph.neighbour[graph.linked]
    inside = mask[source] & mask[target]
    label = connected_components(count, source[inside], target[inside])
    out = np.full(count, -1, np.int64)
    out[mask] = np.unique(label[mask], return_inverse=True)[1]
    return out


def linked(graph: BodyGraph, selected: Mask) -> Mask:
    """Mask (N,) of every splat that hangs together with a selected one."""
    piece = pieces(graph, np.ones(len(selected), np.bool_))
    return np.isin(piece, np.unique(piece[selected]))


def worst_clusters(graph: BodyGraph, confidence: Array, share: float, smallest: int = 5) -> list[Array]:
    """Indices of the splats of each connected group among the least sure, the one with the most doubt first.

    confidence (N,), 0 to 1; share: part of the splats that counts as the least sure, 0 to 1; groups of fewer than
    `smallest` splats are left out. Doubt of a group: the sum of 1 - confidence.
    """
    unsure = np.zeros(len(confidence), np.bool_)
    unsure[np.argsort(confidence, kind="stable")[: round(share * len(confidence))]] = True
    piece = pieces(graph, unsure)
    rows = np.flatnonzero(unsure)
    sizes = np.bincount(piece[rows], minlength=1)
    doubt = np.bincount(piece[rows], 1.0 - confidence[rows], minlength=1)
    order = [label for label in np.argsort(-doubt, kind="stable").tolist() if sizes[label] >= smallest]
    rows = rows[np.argsort(piece[rows], kind="stable")]
    ends = np.cumsum(sizes)
    return [rows[ends[label] - sizes[label] : ends[label]] for label in order]


def alike(index: Array, value: Array, reference: Array) -> Array:
    """(N,) float32, 0 to 1: how much of its weights each splat has in common with weights `reference` (B,), sum 1.

    index, value (N, K): bones of each splat and their weights, which sum to 1; the sum over bones of the smaller
    weight (histogram intersection, Swain and Ballard 1991): 1 moves exactly with it, 0 shares no bone.
    """
    return np.asarray(np.minimum(value, np.asarray(reference)[index]).sum(axis=1), np.float32)


THICK = 8
"""Times the size of a gap that a surface, seen askew, may reach in depth within one cell of the picture."""


def in_front(points: Array, view: ArrayLike, projection: ArrayLike, size: float) -> Mask:
    """Mask (N,) of the points (N, 3) that nothing hides from a view: going from the eye into the picture there is no
    gap of more than `size` metres before them.

    view, projection (4, 4) as OpenGL has them. Points count as one behind the other within cells of the picture that
    are `size` wide at the points' usual depth. What lies `THICK` times the size behind the first is hidden anyway.
    """
    V, P = np.asarray(view, np.float64), np.asarray(projection, np.float64)
    eye = np.asarray(points, np.float64) @ V[:3, :3].T + V[:3, 3]
    clip = eye @ P[:3, :3].T + P[:3, 3]
    w = eye @ P[3, :3] + P[3, 3]
    # With parallel rays there is no eye: Blender's views have their middle at depth 0, and half of what is seen before.
    parallel = P[3, 3] != 0.0
    rows = np.flatnonzero((w > 1e-9) & (parallel | (eye[:, 2] < 0)))
    out = np.zeros(len(eye), np.bool_)
    if not len(rows):
        return out
    depth = -eye[rows, 2]
    cell = size * np.abs(P[[0, 1], [0, 1]]) / float(np.median(w[rows]))
    place = np.floor(clip[rows, :2] / w[rows, None] / np.maximum(cell, 1e-9)).astype(np.int64)
    place -= place.min(axis=0)
    key = place[:, 1] * (int(place[:, 0].max()) + 1) + place[:, 0]
    order = np.lexsort((depth, key))
    rows, key, depth = rows[order], key[order], depth[order]
    begins = np.concatenate([[True], key[1:] != key[:-1]])
    gaps = np.cumsum(np.concatenate([[0.0], np.diff(depth)]) * ~begins > size)
    first = np.maximum.accumulate(np.where(begins, np.arange(len(key)), 0))
    out[rows] = (gaps == gaps[first]) & (depth <= depth[first] + THICK * size)
    return out
