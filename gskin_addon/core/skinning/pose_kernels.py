# SPDX-License-Identifier: GPL-3.0-or-later
"""Eq. 1 and Eq. 3 for all splats and poses at once, with the gradient to the weights, as numba kernels.

torch needs a dozen passes over (poses x splats) arrays for it; here a splat's blended transforms stay in the
first-level cache. `posing.pose_splats` in torch operations is the slow reference.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import float32, njit
from numpy.typing import NDArray

from ..render.cpu.threads import parallel_for, row_ranges
from ..render.cpu.vec8 import broadcast, fma, load, store
from ..rig.lbs import nearest_rotation
from ..rig.quaternion import matrix_to_quat

Array = NDArray[np.float32]

@njit(cache=True, nogil=True)
def _dominant(weights, n):  # type: ignore[no-untyped-def]
    best = 0
    for b in range(1, weights.shape[1]):
        if weights[n, b] > weights[n, best]:
            best = b
    return best


@njit(cache=True, nogil=True)
def _combine(factors, count, rows, start, width, out):  # type: ignore[no-untyped-def]
    """out[:width] = sum of factors[j] * rows[start + j * width :][:width] for j < count; width a multiple of 8."""
    for k in range(0, width, 8):
        even, odd = broadcast(float32(0.0)), broadcast(float32(0.0))
        at = start + k
        for j in range(0, count - 1, 2):
            even = fma(broadcast(factors[j]), load(rows, at), even)
            odd = fma(broadcast(factors[j + 1]), load(rows, at + width), odd)
            at += 2 * width
        if count % 2:
            even = fma(broadcast(factors[count - 1]), load(rows, at), even)
        store(out, k, even + odd)


@njit(cache=True, nogil=True)
def _multiply(w, a, b, c, q):  # type: ignore[no-untyped-def]
    """Hamilton product of (w, a, b, c) and q, not normalised, and 1 / its length."""
    u0 = w * q[0] - a * q[1] - b * q[2] - c * q[3]
    u1 = w * q[1] + a * q[0] + b * q[3] - c * q[2]
    u2 = w * q[2] - a * q[3] + b * q[0] + c * q[1]
    u3 = w * q[3] + a * q[2] - b * q[1] + c * q[0]
    return u0, u1, u2, u3, float32(1.0) / max(np.sqrt(u0 * u0 + u1 * u1 + u2 * u2 + u3 * u3), float32(1e-12))


@njit(cache=True, nogil=True)
def _forward(lo, hi, means, quats, weights, poses, table, turns, out_means, out_quats, blend):  # type: ignore[no-untyped-def]
    """table, turns: see `_tables`; blend (N, W4) is kept for `_backward`."""
    bones, wide, narrow = weights.shape[1], _up8(12 * poses), _up8(4 * poses)
    affine = np.empty(wide, np.float32)
    for n in range(lo, hi):
        dominant = _dominant(weights, n)
        turn = blend[n]
        _combine(weights[n], bones, table, 0, wide, affine)
        _combine(weights[n], bones, turns, dominant * bones * narrow, narrow, turn)
        x, y, z = means[n, 0], means[n, 1], means[n, 2]
        for p in range(poses):
            for i in range(3):
                k = 12 * p + 4 * i
                out_means[p, n, i] = affine[k] * x + affine[k + 1] * y + affine[k + 2] * z + affine[k + 3]
            w, a, b, c = turn[4 * p], turn[4 * p + 1], turn[4 * p + 2], turn[4 * p + 3]
            u0, u1, u2, u3, inverse = _multiply(w, a, b, c, quats[n])
            out_quats[p, n, 0], out_quats[p, n, 1] = u0 * inverse, u1 * inverse
            out_quats[p, n, 2], out_quats[p, n, 3] = u2 * inverse, u3 * inverse


@njit(cache=True, nogil=True)
def _backward(  # type: ignore[no-untyped-def]
    lo, hi, means, quats, weights, poses, table, turns, posed, blend, grad_means, grad_quats, out
):
    """out (N, B): gradient to the weights; tables transposed; posed (P, N, 4): what `_forward` wrote."""
    bones = weights.shape[1]
    wide, narrow, padded = _up8(12 * poses), _up8(4 * poses), _up8(bones)
    affine, turn = np.zeros(wide, np.float32), np.zeros(narrow, np.float32)
    by_affine, by_turn = np.empty(padded, np.float32), np.empty(padded, np.float32)
    for n in range(lo, hi):
        x, y, z = means[n, 0], means[n, 1], means[n, 2]
        q0, q1, q2, q3 = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        for p in range(poses):
            for i in range(3):
                k, g = 12 * p + 4 * i, grad_means[p, n, i]
                affine[k], affine[k + 1], affine[k + 2], affine[k + 3] = g * x, g * y, g * z, g
            # Through the normalisation, then through the product with the rest rotation.
            k = 4 * p
            inverse = _multiply(blend[n, k], blend[n, k + 1], blend[n, k + 2], blend[n, k + 3], quats[n])[4]
            o0, o1, o2, o3 = posed[p, n, 0], posed[p, n, 1], posed[p, n, 2], posed[p, n, 3]
            g0, g1, g2, g3 = grad_quats[p, n, 0], grad_quats[p, n, 1], grad_quats[p, n, 2], grad_quats[p, n, 3]
            along = g0 * o0 + g1 * o1 + g2 * o2 + g3 * o3
            g0, g1 = (g0 - along * o0) * inverse, (g1 - along * o1) * inverse
            g2, g3 = (g2 - along * o2) * inverse, (g3 - along * o3) * inverse
            turn[k] = g0 * q0 + g1 * q1 + g2 * q2 + g3 * q3
            turn[k + 1] = g1 * q0 - g0 * q1 - g2 * q3 + g3 * q2
            turn[k + 2] = g2 * q0 - g0 * q2 - g3 * q1 + g1 * q3
            turn[k + 3] = g3 * q0 - g0 * q3 - g1 * q2 + g2 * q1
        _combine(affine, wide, table, 0, padded, by_affine)
        _combine(turn, narrow, turns, _dominant(weights, n) * narrow * padded, padded, by_turn)
        for b in range(bones):
            out[n, b] = by_affine[b] + by_turn[b]


@njit(cache=True, nogil=True)
def _up8(count):  # type: ignore[no-untyped-def]
    return (count + 7) // 8 * 8


def _tables(transforms: NDArray[Any]) -> tuple[Array, Array]:
    """Of P poses: affine maps (B, 12 P) and quaternions (B, B, 4 P), the first index the dominant bone whose
    hemisphere counts; the last axis padded with zeros to a multiple of 8."""
    poses, bones = transforms.shape[:2]
    quat = matrix_to_quat(nearest_rotation(np.asarray(transforms, np.float64)[..., :3, :3]))
    sign = np.where(np.einsum("pak,pbk->pab", quat, quat) < 0, -1.0, 1.0)
    table = transforms[:, :, :3, :].transpose(1, 0, 2, 3).reshape(bones, 12 * poses)
    turns = np.einsum("pab,pbk->abpk", sign, quat).reshape(bones, bones, 4 * poses)
    return _padded(table), _padded(turns)


def _padded(values: NDArray[Any]) -> Array:
    out = np.zeros((*values.shape[:-1], (values.shape[-1] + 7) // 8 * 8), np.float32)
    out[..., : values.shape[-1]] = values
    return out


class _Pose(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights, means, quats, transforms):  # type: ignore[no-untyped-def]
        count, poses = len(means), len(transforms)
        w = np.ascontiguousarray(weights.detach().numpy())
        table, turns = _tables(transforms)
        out_means, out_quats = np.empty((poses, count, 3), np.float32), np.empty((poses, count, 4), np.float32)
        blend = np.empty((count, turns.shape[-1]), np.float32)
        ctx.known = means, quats, w, poses
        ctx.kept = table, turns, out_quats, blend
        parallel_for(_forward, row_ranges(count), *ctx.known, table.ravel(), turns.ravel(), out_means, out_quats, blend)
        return torch.from_numpy(out_means), torch.from_numpy(out_quats)

    @staticmethod
    def backward(ctx, grad_means, grad_quats):  # type: ignore[no-untyped-def]
        table, turns, posed, blend = ctx.kept
        out = np.empty(ctx.known[2].shape, np.float32)
        gm, gq = (np.ascontiguousarray(grad.numpy()) for grad in (grad_means, grad_quats))
        table, turns = (_padded(a.swapaxes(-1, -2)).ravel() for a in (table, turns))
        parallel_for(_backward, row_ranges(len(out)), *ctx.known, table, turns, posed, blend, gm, gq, out)
        return torch.from_numpy(out), None, None, None


def pose_splats_fused(
    means: Array, quats: Array, weights: torch.Tensor, transforms: NDArray[Any]
) -> tuple[torch.Tensor, torch.Tensor]:
    """`posing.pose_splats` on the CPU in float32: means (N, 3), quats (N, 4), weights (N, B), transforms
    (P, B, 4, 4) -> centres (P, N, 3), unit rotations (P, N, 4), with a gradient to the weights."""
    result: tuple[torch.Tensor, torch.Tensor] = _Pose.apply(weights, means, quats, transforms)  # type: ignore[no-untyped-call]
    return result
