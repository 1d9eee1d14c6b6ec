# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear blend skinning of splats: positions (Eq. 1), rotations (Eq. 3), and utilities on weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..splats.cloud import SplatCloud
from ..splats.sh import rotate_sh as rotate_coefficients
from .bendy import BendyBone
from .covariance import transform_gaussians
from .quaternion import matrix_to_quat, nearest_rotation, normalize, quat_multiply, quat_to_matrix
from .stretch import RIGID, polar, second_moments, size, spread, stretched_maps, unevenness

Array = NDArray[Any]

PART = 1 << 18
"""Weights that are sorted at a time."""


def skin_points(points: Array, weights: Array, transforms: Array) -> Array:
    """Eq. 1: x' = sum_b w_b P_b x.

    points (N, 3), weights (N, B) with rows that sum to 1, transforms (..., B, 4, 4) -> (..., N, 3), in the
    float type of `points`.
    """
    points = np.asarray(points)
    dtype = points.dtype if np.issubdtype(points.dtype, np.floating) else np.dtype(np.float64)
    transforms = np.asarray(transforms, dtype=dtype)
    weights = np.asarray(weights, dtype=dtype)
    _check_shapes(len(points), weights, transforms)
    lead, bones = transforms.shape[:-3], transforms.shape[-3]
    out = np.empty((*lead, len(points), 3), dtype=dtype)
    # Blending 3x4 matrices first is one matrix product per pose instead of B transformed copies of the
    # points.
    for index in np.ndindex(*lead):
        blended = (weights @ transforms[index][:, :3, :].reshape(bones, 12)).reshape(-1, 3, 4)
        out[index] = np.einsum("nij,nj->ni", blended[:, :, :3], points) + blended[:, :, 3]
    return out


def skin_quats(weights: Array, transforms: Array) -> Array:
    """The blended rotation of Eq. 3: q = normalise(sum_b w_b s_b q_b), q_b the rotation of P_b.

    q and -q are the same rotation, so the sum needs signs: s_b makes q_b agree with the splat's dominant
    bone. weights (N, B), transforms (..., B, 4, 4) -> (..., N, 4) unit wxyz. Scale or shear in P_b is taken
    out first (polar decomposition).
    """
    weights = np.asarray(weights)
    transforms = np.asarray(transforms, dtype=np.float64)
    _check_shapes(len(weights), weights, transforms)
    quats = matrix_to_quat(nearest_rotation(transforms[..., :3, :3]))
    dtype = weights.dtype if np.issubdtype(weights.dtype, np.floating) else np.dtype(np.float64)
    lead = transforms.shape[:-3]
    out = np.empty((*lead, len(weights), 4), dtype=dtype)
    for index in np.ndindex(*lead):
        out[index] = blend_quats(weights, quats[index])
    return out


def blend_quats(weights: Array, quats: Array) -> Array:
    """normalise(sum_b w_b s_b q_b) for weights (N, B) and unit quaternions (B, 4): Eq. 3, signs as in `skin_quats`."""
    dtype = weights.dtype if np.issubdtype(weights.dtype, np.floating) else np.dtype(np.float64)
    sign = np.where(quats @ quats.T < 0, -1.0, 1.0).astype(dtype)
    return normalize((weights * sign[np.argmax(weights, axis=1)]) @ quats.astype(dtype))


def skin_cloud(
    cloud: SplatCloud,
    weights: Array,
    transforms: Array,
    *,
    rotate_sh: bool = True,
    bends: Mapping[int, BendyBone] | None = None,
) -> SplatCloud:
    """The posed cloud: centres by Eq. 1, covariances turned by Eq. 3, SH coefficients turned with them.

    weights (N, B) with rows that sum to 1, transforms (B, 4, 4); bends: the bones among them that bend. Splats of
    bones that are scaled, sheared, mirrored or bent are turned and stretched by the local linear map (`stretch.py`).
    With `rotate_sh=False` the coefficients stay as they are, for a renderer that turns the view direction instead.
    """
    if np.ndim(transforms) != 3:
        raise ValueError(f"skin_cloud takes one pose (B, 4, 4), got shape {np.shape(transforms)}")
    posed = _skin_turned(cloud, weights, transforms, rotate_sh)
    bent = {bone: bend for bone, bend in (bends or {}).items() if bend.is_bent(transforms[bone])}
    odd = unevenness(np.asarray(transforms)[:, :3, :3])[0] > RIGID
    odd[list(bent)] = True
    rows = np.flatnonzero((np.asarray(weights)[:, odd] > 0).any(axis=1))
    for first in range(0, len(rows), PART // 4):
        some = rows[first : first + PART // 4]
        points = cloud.means[some].astype(np.float64)
        means, turn, maps, mirrored = local_deform(points, weights[some], transforms, bent)
        posed = stretch_rows(posed, cloud, some, turn, maps, mirrored, rotate_sh=rotate_sh)
        posed.means[some] = means
    return posed


def local_deform(
    points: Array, weights: Array, transforms: Array, bends: Mapping[int, BendyBone]
) -> tuple[Array, Array, Array, Array]:
    """Where points (N, 3) go, (N, 3), and how what is around them turns and stretches.

    weights (N, B) with rows that sum to 1, transforms (B, 4, 4), bends by bone. Gives turns (N, 4) and maps (N, 3, 3)
    as `stretch.stretched_maps`, and which maps mirror, (N,) bool. float64.
    """
    weights, transforms = np.array(weights, dtype=np.float64), np.asarray(transforms, dtype=np.float64)
    quats = polar(transforms[:, :3, :3])[0]
    dominant = np.argmax(weights, axis=1)
    leading = quats[dominant]
    uneven = np.where(weights > 0, unevenness(transforms[:, :3, :3])[1], 0)
    lengths, held = np.tile(size(transforms[:, :3, :3]), (len(weights), 1)), weights > 0
    found = []
    for bone, bend in bends.items():
        rows = np.flatnonzero(weights[:, bone] > 0)
        if len(rows):
            part = bend.deform(points[rows])
            found.append((rows, weights[rows, bone], *part))
            leads = dominant[rows] == bone
            leading[rows[leads]] = part[2][leads]
            uneven[rows, bone], lengths[rows, bone] = part[3], part[4]
    weights[:, list(bends)] = 0
    blended = (weights @ transforms[:, :3, :].reshape(-1, 12)).reshape(-1, 3, 4)
    maps = blended[:, :, :3].copy()
    means = np.einsum("nij,nj->ni", maps, points) + blended[:, :, 3]
    turn = (weights * np.where(leading @ quats.T < 0, -1.0, 1.0)) @ quats
    moments = second_moments(weights * size(transforms[:, :3, :3]), quats)
    for rows, weight, moved, local, quat, _, sizes in found:
        means[rows] += weight[:, None] * moved
        maps[rows] += weight[:, None, None] * local
        sign = np.where(np.einsum("nk,nk->n", leading[rows], quat) < 0, -weight, weight)
        turn[rows] += sign[:, None] * quat
        moments[rows] += (weight * sizes)[:, None, None] * quat[:, :, None] * quat[:, None, :]
    apart = np.maximum(uneven.max(axis=1), spread(lengths, held))
    return means, *stretched_maps(maps, normalize(turn), moments, apart)


def stretch_rows(
    posed: SplatCloud,
    rest: SplatCloud,
    rows: Array,
    turn: Array,
    maps: Array,
    mirrored: Array,
    *,
    rotate_sh: bool = True,
) -> SplatCloud:
    """The posed cloud with shapes and harmonics of the splats `rows` (K,) made anew from the cloud at rest.

    turn (K, 4), maps (K, 3, 3) as `local_deform` gives them, mirrored (K,) bool: harmonics of odd degree change sign.
    """
    quats, scales, sh = posed.quats.copy(), posed.scales.copy(), posed.sh
    quats[rows], scales[rows] = transform_gaussians(rest.quats[rows], rest.scales[rows], maps)
    if rotate_sh and sh.shape[1] > 1:
        sh = sh.copy()
        degree = np.floor(np.sqrt(np.arange(sh.shape[1]))).astype(int)
        sign = np.where(mirrored[:, None] & (degree % 2 == 1), -1, 1).astype(sh.dtype)
        sh[rows] = rotate_coefficients(rest.sh[rows] * sign[:, :, None], quat_to_matrix(turn))
    return dataclasses.replace(posed, quats=quats, scales=scales, sh=sh)


def _skin_turned(cloud: SplatCloud, weights: Array, transforms: Array, rotate_sh: bool) -> SplatCloud:
    turn = skin_quats(weights, transforms)
    means = skin_points(cloud.means, weights, transforms).astype(np.float32)
    quats = normalize(quat_multiply(turn, cloud.quats)).astype(np.float32)
    sh = cloud.sh
    if rotate_sh and sh.shape[1] > 1:
        sh = rotate_coefficients(sh, quat_to_matrix(turn))
    return dataclasses.replace(cloud, means=means, quats=quats, sh=sh)


def top_influences(weights: Array, k: int) -> tuple[Array, Array]:
    """The k strongest bones of each splat: index (N, k) int, weight (N, k) falling, rows sum to 1; k at most
    B.

    A row without any weight gets its first index with weight 1, so that the splat still follows a bone.
    """
    weights = np.asarray(weights)
    if k < 1:
        raise ValueError(f"at least one influence per splat is needed, got {k}")
    count, bones = weights.shape
    k = min(k, bones)
    # By parts: sorting takes three times the memory of what is sorted.
    rows = max(1, PART // max(1, bones))
    index = np.empty((count, k), dtype=np.intp)
    value = np.empty((count, k), dtype=np.true_divide(weights[:0], 1).dtype)
    for first in range(0, count, rows):
        part = slice(first, first + rows)
        index[part], value[part] = _top_of(weights[part], k)
    return index, value


def few_influences(weights: Array, k: int) -> tuple[Array, Array] | None:
    """`top_influences` of weights (N, B) of which no row has more than k bones above 0, without sorting all B.

    None where a row has more, or none at all. Slots without a bone have weight 0 and any index.
    """
    weights = np.asarray(weights)
    held = weights > 0
    counts = np.count_nonzero(held, axis=1)
    if k < 1 or (len(counts) and not 0 < counts.min() <= counts.max() <= k):
        return None
    row, column = np.nonzero(held)
    slot = np.arange(len(row)) - np.repeat(counts.cumsum() - counts, counts)
    k = min(k, weights.shape[1])
    index = np.zeros((len(weights), k), dtype=np.intp)
    value = np.zeros((len(weights), k), dtype=weights.dtype)
    index[row, slot], value[row, slot] = column, weights[row, column]
    order = np.argsort(-value, axis=1, kind="stable")
    value = np.take_along_axis(value, order, axis=1)
    return np.take_along_axis(index, order, axis=1), value / value.sum(axis=1, keepdims=True)


def _top_of(weights: Array, k: int) -> tuple[Array, Array]:
    """`top_influences` in one go."""
    if k < weights.shape[1]:
        index = np.argpartition(-weights, k - 1, axis=1)[:, :k]
    else:
        index = np.broadcast_to(np.arange(k), weights.shape).copy()
    value = np.take_along_axis(weights, index, axis=1)
    order = np.argsort(-value, axis=1, kind="stable")
    index = np.take_along_axis(index, order, axis=1)
    value = np.maximum(np.take_along_axis(value, order, axis=1), 0)
    total = value.sum(axis=1, keepdims=True)
    empty = total[:, 0] <= 0
    value = value / np.where(total > 0, total, 1)
    value[empty, 0] = 1
    return index, value


def sparsify(weights: Array, k: int) -> Array:
    """Weights (N, B) with only each row's k strongest bones, normalised to sum 1."""
    index, value = top_influences(weights, k)
    out = np.zeros_like(np.asarray(weights))
    np.put_along_axis(out, index, value.astype(out.dtype), axis=1)
    return out


def _check_shapes(points: int, weights: Array, transforms: Array) -> None:
    if transforms.ndim < 3 or transforms.shape[-2:] != (4, 4):
        raise ValueError(f"transforms have shape {transforms.shape}, expected (..., B, 4, 4)")
    if weights.shape != (points, transforms.shape[-3]):
        raise ValueError(f"weights have shape {weights.shape}, expected {(points, transforms.shape[-3])}")
