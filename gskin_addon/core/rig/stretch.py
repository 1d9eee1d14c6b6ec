# SPDX-License-Identifier: GPL-3.0-or-later
"""How a blend of bone transforms that stretch, and not only turn, maps the space around each splat. numpy only.

Rotations alone are blended by Eq. 3. Where a bone of a splat is sheared, mirrored, bent, or scaled by another factor
than its others, the splat follows the local linear map of the deformation: turned by the map's own rotation, and
stretched. Bones that are all scaled evenly by one factor are no reason to leave Eq. 3. What a linear blend of different
rotations loses in size (the joint that collapses) is no stretch of anybody's and is given back.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .quaternion import matrix_to_quat, normalize, quat_to_matrix

Array = NDArray[Any]

RIGID = 1e-4
"""Largest stretch (Frobenius norm of U - I) that still counts as a rotation."""
PLAINLY = 1e-2
"""Uneven stretch from which on a splat turns by its map alone; between the two it goes over smoothly from Eq. 3."""
COLLAPSED = 0.05
"""Sum of the two smaller singular values, relative to the largest, below which a map has no rotation of its own."""


def polar(maps: Array) -> tuple[Array, Array, Array]:
    """A = p R U for maps A (..., 3, 3): R as unit quaternions (..., 4), U (..., 3, 3) symmetric, parity p (...) +-1.

    A mirroring map is minus a rotation times a stretch: the sign changes no covariance, and bones that are all
    mirrored blend as they would without. U has no negative eigenvalue.
    """
    maps = np.asarray(maps, dtype=np.float64)
    parity = np.where(np.linalg.det(maps) < 0, -1.0, 1.0)
    u, s, vt = np.linalg.svd(maps * parity[..., None, None])
    # A map without volume may come with either orientation.
    last = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    u = u * np.stack([np.ones_like(last), np.ones_like(last), last], axis=-1)[..., None, :]
    stretch = np.swapaxes(vt, -1, -2) @ (s[..., :, None] * vt)
    return matrix_to_quat(u @ vt), stretch, parity


def size(maps: Array) -> Array:
    """By how much maps (..., 3, 3) enlarge, (...): the root of the mean of the squared stretches."""
    return np.asarray(np.linalg.norm(maps, axis=(-2, -1)) / np.sqrt(3))


def unevenness(maps: Array) -> tuple[Array, Array]:
    """How far maps A (..., 3, 3) are from rotations and, each (...), from rotations times a scale.

    Half the Frobenius norm of A^T A - I, which for small stretches is that of U - I; and the same of A / `size`. A map
    that mirrors is at least 1 away from a rotation.
    """
    maps = np.asarray(maps, dtype=np.float64)
    gram = np.swapaxes(maps, -1, -2) @ maps
    length = np.maximum(size(maps), 1e-12)[..., None, None] ** 2
    own, even = (np.linalg.norm(g - np.eye(3), axis=(-2, -1)) / 2 for g in (gram, gram / length))
    return np.maximum(own, np.linalg.det(maps) < 0), even


def spread(sizes: Array, weights: Array) -> Array:
    """How far the sizes (N, B) of the bones that have weight (N, B) are apart: largest over smallest, less 1; (N,)."""
    held = np.asarray(weights) > 0
    largest = np.where(held, sizes, 0).max(axis=1)
    smallest = np.where(held, sizes, np.inf).min(axis=1)
    return np.asarray(np.where(held.any(axis=1), largest / np.maximum(smallest, 1e-12), 1) - 1)


def second_moments(weights: Array, quats: Array) -> Array:
    """sum_b w_b q_b q_b^T, (N, 4, 4), for weights (N, B) and unit quaternions (B, 4); signs do not matter."""
    outer = quats[:, :, None] * quats[:, None, :]
    return np.asarray((np.asarray(weights, np.float64) @ outer.reshape(len(quats), 16)).reshape(-1, 4, 4))


def stretched_maps(maps: Array, turn: Array, moments: Array, uneven: Array) -> tuple[Array, Array, Array]:
    """What turns splats and what stretches them: unit quaternions R (N, 4) and maps M = R S (N, 3, 3).

    Also which splats are mirrored with their bones, (N,) bool: M is minus what J asks for.

    maps (N, 3, 3): the blended local maps J. turn (N, 4): the blended rotation of Eq. 3. moments (N, 4, 4): of the
    quaternions that were blended (`second_moments`), weights times `size` of the bones' maps. uneven (N,): how far the
    bones of each splat are from rotations times one scale; 0 gives R = turn. Where J blends rotations Q_b times scales
    s_b, S = sum_b w_b s_b, whatever R is.

    R is the rotation of J, S = (R^T J)_sym + K, and K what blending the rotations lost: the sum of
    w_b s_b (I - (R^T Q_b)_sym).
    """
    maps = np.asarray(maps, dtype=np.float64)
    turn = np.asarray(turn, dtype=np.float64)
    # Not by the determinant: where a bend folds the space, J mirrors and no bone does.
    mirrored = np.einsum("nij,nij->n", quat_to_matrix(turn), maps) < 0
    maps = np.where(mirrored[:, None, None], -maps, maps)
    share = np.clip((np.asarray(uneven) - RIGID) / (PLAINLY - RIGID), 0, 1)
    share = share * share * (3 - 2 * share)
    u, s, vt = np.linalg.svd(maps)
    folded = np.asarray(np.linalg.det(u @ vt) < 0)
    share = share * ((s[:, 1] + s[:, 2] > COLLAPSED * s[:, 0]) & ~folded)
    u[:, :, 2] *= np.where(folded, -1, 1)[:, None]
    own = matrix_to_quat(u @ vt)
    own = np.where(np.einsum("nk,nk->n", own, turn)[:, None] < 0, -own, own)
    blended = normalize(turn + share[:, None] * (own - turn))
    rotation = quat_to_matrix(blended)
    own_frame = np.swapaxes(rotation, 1, 2) @ maps
    stretch = (own_frame + np.swapaxes(own_frame, 1, 2)) / 2 + _lost(blended, moments)
    return blended, rotation @ stretch, mirrored


def _lost(turn: Array, moments: Array) -> Array:
    """K (N, 3, 3) = sum_b w_b (I - (R^T Q_b)_sym) = 2 (tr V I - V), V = sum_b w_b v_b v_b^T, v_b the vector part of
    conj(turn) q_b."""
    w, x, y, z = np.moveaxis(turn, -1, 0)
    part = np.stack([np.stack([-x, w, z, -y], -1), np.stack([-y, -z, w, x], -1), np.stack([-z, y, -x, w], -1)], -2)
    v = part @ moments @ np.swapaxes(part, 1, 2)
    return np.asarray(2 * (np.trace(v, axis1=1, axis2=2)[:, None, None] * np.eye(3) - v))
