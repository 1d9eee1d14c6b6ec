# SPDX-License-Identifier: GPL-3.0-or-later
"""numba kernels that take splats to the image plane, fill the tiles, and take gradients back to 3D.

EWA splatting as in 3D Gaussian Splatting (Kerbl et al. 2023, Sec. 4 and the published CUDA code): with
V = R diag(s), W the camera's rotation and J the Jacobian of the projection at the mean, the image covariance
is (J W V)(J W V)^T + dilation. The kernels over splats take a range [lo, hi), so that threads share the work.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

TILE = 32
"""Pixels along the side of a tile; a tile's running state (4 KB per quantity) then stays in the L1 cache."""

ALPHA_CUT = 1.0 / 255.0
LOG2E = 1.4426950408889634

# Columns of the per-splat record: log2(alpha) = K - A dx^2 - B dx dy - C dy^2 around the mean. Alpha reaches 1/255 on
# rows with |dy| <= RY only, and there only within WIDE pixels of the ridge dx = -LEAN dy.
A, B, C, K, RY, WIDE, LEAN, RECORD = 0, 1, 2, 3, 4, 5, 6, 8

CAMERA = 24
"""Length of the vector that the kernels read: rotation 0-8, translation 9-11, fx fy near 12-14, slope
bounds x/z 16-17 and y/z 18-19, dilation 20, compensation 21 (negative for none), cx cy 22-23."""


@njit(cache=True, nogil=True)
def _project_one(i: int, means: Any, quats: Any, scales: Any, cam: Any) -> Any:
    """Splat i: camera point, unit quaternion, 1 / its norm, clamped slopes, R, T = J W and U = J W R diag(s).

    Matrices are tuples in row order, so that they live in registers.
    """
    px, py, pz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    x = cam[0] * px + cam[1] * py + cam[2] * pz + cam[9]
    y = cam[3] * px + cam[4] * py + cam[5] * pz + cam[10]
    z = cam[6] * px + cam[7] * py + cam[8] * pz + cam[11]
    w, a, b, c = (
        np.float64(quats[i, 0]),
        np.float64(quats[i, 1]),
        np.float64(quats[i, 2]),
        np.float64(quats[i, 3]),
    )
    norm = np.sqrt(w * w + a * a + b * b + c * c)
    inverse = 1.0 / norm if norm > 0.0 else 0.0
    w, a, b, c = w * inverse, a * inverse, b * inverse, c * inverse
    R = (
        1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b),
        2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a),
        2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b),
    )  # fmt: skip
    iz = 1.0 / z if z != 0.0 else 0.0
    # The slope is clamped in J only, so that splats beside the image do not blow up (as INRIA and gsplat do).
    u = min(max(x * iz, cam[16]), cam[17])
    v = min(max(y * iz, cam[18]), cam[19])
    j00, j02, j11, j12 = cam[12] * iz, -cam[12] * u * iz, cam[13] * iz, -cam[13] * v * iz
    t0, t1, t2 = j00 * cam[0] + j02 * cam[6], j00 * cam[1] + j02 * cam[7], j00 * cam[2] + j02 * cam[8]
    t3, t4, t5 = j11 * cam[3] + j12 * cam[6], j11 * cam[4] + j12 * cam[7], j11 * cam[5] + j12 * cam[8]
    s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
    U = (
        (t0 * R[0] + t1 * R[3] + t2 * R[6]) * s0, (t0 * R[1] + t1 * R[4] + t2 * R[7]) * s1,
        (t0 * R[2] + t1 * R[5] + t2 * R[8]) * s2, (t3 * R[0] + t4 * R[3] + t5 * R[6]) * s0,
        (t3 * R[1] + t4 * R[4] + t5 * R[7]) * s1, (t3 * R[2] + t4 * R[5] + t5 * R[8]) * s2,
    )  # fmt: skip
    return (x, y, z), (w, a, b, c), inverse, (u, v), R, (t0, t1, t2, t3, t4, t5), U


@njit(cache=True, nogil=True)
def _covariance(U: Any, dilation: float) -> Any:
    """(xx, xy, yy, determinant) of U U^T + dilation; the determinant as a sum without cancellation."""
    xx = U[0] * U[0] + U[1] * U[1] + U[2] * U[2]
    xy = U[0] * U[3] + U[1] * U[4] + U[2] * U[5]
    yy = U[3] * U[3] + U[4] * U[4] + U[5] * U[5]
    m0, m1, m2 = U[1] * U[5] - U[2] * U[4], U[2] * U[3] - U[0] * U[5], U[0] * U[4] - U[1] * U[3]
    det = m0 * m0 + m1 * m1 + m2 * m2 + dilation * (xx + yy) + dilation * dilation
    return xx + dilation, xy, yy + dilation, det


@njit(cache=True, nogil=True)
def project(
    lo: int, hi: int, means: Any, quats: Any, scales: Any, opacities: Any, cam: Any, width: int, height: int,
    pixels: Any, record: Any, depth: Any, rect: Any, tiles: Any,
) -> None:  # fmt: skip
    """Fill, for splats lo..hi, pixels (N,2), record (N,RECORD), depth (N,), rect (N,4) and tiles (N,).

    rect holds tile columns and rows [x0, x1) x [y0, y1), tiles their number: 0 for a splat that shows nowhere.
    The extent is exact: where alpha >= 1/255.
    """
    dilation, compensate = cam[20], cam[21]
    for i in range(lo, hi):
        tiles[i] = 0
        if not opacities[i] >= ALPHA_CUT:
            continue
        point, _q, inverse, _uv, _R, _T, U = _project_one(i, means, quats, scales, cam)
        z = point[2]
        if not z > cam[14] or inverse == 0.0:
            continue
        xx, xy, yy, det = _covariance(U, dilation)
        if not (det > 0.0 and det < np.inf):
            continue
        opacity = np.float64(opacities[i])
        if compensate >= 0.0:
            opacity *= np.sqrt(_covariance(U, compensate)[3] / det)
            if opacity < ALPHA_CUT:
                continue
        mx = cam[12] * point[0] / z + cam[22]
        my = cam[13] * point[1] / z + cam[23]
        reach = 2.0 * np.log(255.0 * opacity)
        rx, ry = np.sqrt(reach * xx), np.sqrt(reach * yy)
        # Pixel i lies at i + 0.5; the slack covers the rounding of the kernels that use single precision.
        left = max(np.ceil(mx - rx - 0.501), 0.0)
        right = min(np.floor(mx + rx - 0.499), width - 1.0)
        top = max(np.ceil(my - ry - 0.501), 0.0)
        bottom = min(np.floor(my + ry - 0.499), height - 1.0)
        if not (left <= right and top <= bottom):
            continue
        x0, x1, y0, y1 = int(left) // TILE, int(right) // TILE + 1, int(top) // TILE, int(bottom) // TILE + 1
        rect[i, 0], rect[i, 1], rect[i, 2], rect[i, 3] = x0, x1, y0, y1
        tiles[i] = (x1 - x0) * (y1 - y0)
        depth[i] = z
        half = 0.5 * LOG2E / det
        pixels[i, 0], pixels[i, 1] = mx, my
        record[i, A], record[i, B], record[i, C] = yy * half, -2.0 * xy * half, xx * half
        record[i, K], record[i, RY] = np.log2(opacity), ry + 0.001
        record[i, WIDE], record[i, LEAN] = np.sqrt(reach * det / yy) + 0.001, -xy / yy


@njit(cache=True, nogil=True)
def count_tiles(rect: Any, tiles: Any, columns: int, first_slot: Any, tile_start: Any) -> None:
    """first_slot (N+1,): where each splat's (splat, tile) pairs start; tile_start (tiles+1,): per tile."""
    tile_start[:] = 0
    first_slot[0] = 0
    for i in range(tiles.shape[0]):
        first_slot[i + 1] = first_slot[i] + tiles[i]
        if tiles[i] > 0:
            for ty in range(rect[i, 2], rect[i, 3]):
                for tx in range(rect[i, 0], rect[i, 1]):
                    tile_start[ty * columns + tx + 1] += 1
    for t in range(tile_start.shape[0] - 1):
        tile_start[t + 1] += tile_start[t]


@njit(cache=True, nogil=True)
def depth_order(tiles: Any, depth_bits: Any, order: Any, spare: Any) -> int:
    """Put the splats that show somewhere into `order` (N,) uint64 from near to far; returns how many there are.

    Radix sort of depth bits << 32 | splat, by the depth only, 11 bits at a time: the bits of a positive float
    sort like the float, and equal depths stay in the order of the splats.
    """
    n = 0
    starts = np.zeros((3, 2049), np.int64)
    for i in range(tiles.shape[0]):
        if tiles[i] > 0:
            bits = np.uint64(depth_bits[i])
            order[n] = bits << np.uint64(32) | np.uint64(i)
            n += 1
            for k in range(3):
                starts[k, ((bits >> np.uint64(11 * k)) & np.uint64(2047)) + np.uint64(1)] += 1
    for k in range(3):
        for b in range(2048):
            starts[k, b + 1] += starts[k, b]
        source, target = (spare, order) if k == 1 else (order, spare)
        for j in range(n):
            key = source[j]
            digit = np.int64((key >> np.uint64(32 + 11 * k)) & np.uint64(2047))
            target[starts[k, digit]] = key
            starts[k, digit] += 1
    order[:n] = spare[:n]
    return n


@njit(cache=True, nogil=True)
def fill_tiles(order: Any, rect: Any, columns: int, first_slot: Any, tile_start: Any, slots: Any, owner: Any) -> None:
    """slots (pairs,): the slots of each tile from near to far; owner (pairs,): the splat of each slot."""
    cursor = tile_start[:-1].copy()
    for key in order:
        i = np.int64(key & np.uint64(0xFFFFFFFF))
        slot = first_slot[i]
        for ty in range(rect[i, 2], rect[i, 3]):
            for tx in range(rect[i, 0], rect[i, 1]):
                t = ty * columns + tx
                slots[cursor[t]] = slot
                owner[slot] = i
                cursor[t] += 1
                slot += 1


@njit(cache=True, nogil=True)
def _quaternion_gradient(G: Any, q: Any, inverse: float) -> Any:
    """From G = dL/dR (9,) to the gradient to the quaternion that was normalised to q (`inverse` = 1 / its norm)."""
    w, x, y, z = q
    gw = 2 * (z * (G[3] - G[1]) + y * (G[2] - G[6]) + x * (G[7] - G[5]))
    gx = 2 * (y * (G[1] + G[3]) + z * (G[2] + G[6]) + w * (G[7] - G[5]) - 2 * x * (G[4] + G[8]))
    gy = 2 * (x * (G[1] + G[3]) + z * (G[5] + G[7]) + w * (G[2] - G[6]) - 2 * y * (G[0] + G[8]))
    gz = 2 * (x * (G[2] + G[6]) + y * (G[5] + G[7]) + w * (G[3] - G[1]) - 2 * z * (G[0] + G[4]))
    along = gw * w + gx * x + gy * y + gz * z
    return (
        (gw - along * w) * inverse, (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse
    )  # fmt: skip


@njit(cache=True, nogil=True)
def project_backward(
    lo: int, hi: int, means: Any, quats: Any, scales: Any, cam: Any, first_slot: Any, partial: Any,
    grad_means: Any, grad_quats: Any,
) -> None:  # fmt: skip
    """Gradients to means (N,3) and quats (N,4) of splats lo..hi from the tiles' sums `partial` (pairs,6).

    The columns of `partial` are sums over pixels of v, v dx, v dy, v dx^2, v dx dy, v dy^2 with
    v = alpha dL/dalpha and (dx, dy) the pixel minus the mean.
    """
    dilation, compensate = cam[20], cam[21]
    for i in range(lo, hi):
        g0, g1, g2, g3, g4, g5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for slot in range(first_slot[i], first_slot[i + 1]):
            g0 += partial[slot, 0]
            g1 += partial[slot, 1]
            g2 += partial[slot, 2]
            g3 += partial[slot, 3]
            g4 += partial[slot, 4]
            g5 += partial[slot, 5]
        if g0 == 0.0 and g1 == 0.0 and g2 == 0.0 and g3 == 0.0 and g4 == 0.0 and g5 == 0.0:
            grad_means[i, :] = 0.0
            grad_quats[i, :] = 0.0
            continue
        point, q, inverse, uv, R, T, U = _project_one(i, means, quats, scales, cam)
        xx, xy, yy, det = _covariance(U, dilation)
        a, b, c = yy / det, -xy / det, xx / det  # inverse covariance
        # ln alpha = ln o - (a dx^2 + 2 b dx dy + c dy^2) / 2
        gx, gy = a * g1 + b * g2, b * g1 + c * g2
        # H = dL/dcovariance = inverse (sum v d d^T) inverse / 2
        px, py, qx, qy = a * g3 + b * g4, a * g4 + b * g5, b * g3 + c * g4, b * g4 + c * g5
        hxx, hxy, hyy = 0.5 * (px * a + py * b), 0.5 * (px * b + py * c), 0.5 * (qx * b + qy * c)
        if compensate >= 0.0:
            exx, exy, eyy, edet = _covariance(U, compensate)
            if edet > 0.0:
                # d ln sqrt(det(S + e) / det(S + dilation)) / dS
                hxx += 0.5 * g0 * (eyy / edet - a)
                hxy += 0.5 * g0 * (-exy / edet - b)
                hyy += 0.5 * g0 * (exx / edet - c)
        # D = dL/d(T R) = dL/dU diag(s), where dL/dU = 2 H U
        s0, s1, s2 = 2.0 * scales[i, 0], 2.0 * scales[i, 1], 2.0 * scales[i, 2]
        d0, d1, d2 = (
            (hxx * U[0] + hxy * U[3]) * s0,
            (hxx * U[1] + hxy * U[4]) * s1,
            (hxx * U[2] + hxy * U[5]) * s2,
        )
        d3, d4, d5 = (
            (hxy * U[0] + hyy * U[3]) * s0,
            (hxy * U[1] + hyy * U[4]) * s1,
            (hxy * U[2] + hyy * U[5]) * s2,
        )
        G = (
            T[0] * d0 + T[3] * d3, T[0] * d1 + T[3] * d4, T[0] * d2 + T[3] * d5,
            T[1] * d0 + T[4] * d3, T[1] * d1 + T[4] * d4, T[1] * d2 + T[4] * d5,
            T[2] * d0 + T[5] * d3, T[2] * d1 + T[5] * d4, T[2] * d2 + T[5] * d5,
        )  # fmt: skip
        gq = _quaternion_gradient(G, q, inverse)
        grad_quats[i, 0], grad_quats[i, 1], grad_quats[i, 2], grad_quats[i, 3] = gq[0], gq[1], gq[2], gq[3]

        # dL/dT = D R^T, and with T = J W the four entries of dL/dJ that matter
        t0, t1, t2 = (d0 * R[0] + d1 * R[1] + d2 * R[2], d0 * R[3] + d1 * R[4] + d2 * R[5],
                      d0 * R[6] + d1 * R[7] + d2 * R[8])  # fmt: skip
        t3, t4, t5 = (d3 * R[0] + d4 * R[1] + d5 * R[2], d3 * R[3] + d4 * R[4] + d5 * R[5],
                      d3 * R[6] + d4 * R[7] + d5 * R[8])  # fmt: skip
        j00, j02 = t0 * cam[0] + t1 * cam[1] + t2 * cam[2], t0 * cam[6] + t1 * cam[7] + t2 * cam[8]
        j11, j12 = t3 * cam[3] + t4 * cam[4] + t5 * cam[5], t3 * cam[6] + t4 * cam[7] + t5 * cam[8]
        iz = 1.0 / point[2]
        fx, fy = cam[12] * iz, cam[13] * iz
        dx, dy = fx * gx, fy * gy
        dz = -iz * (dx * point[0] + dy * point[1] + fx * j00 + fy * j11 - fx * uv[0] * j02 - fy * uv[1] * j12)
        if point[0] * iz == uv[0]:  # the slope was not clamped
            dx -= fx * iz * j02
            dz += fx * iz * uv[0] * j02
        if point[1] * iz == uv[1]:
            dy -= fy * iz * j12
            dz += fy * iz * uv[1] * j12
        grad_means[i, 0] = cam[0] * dx + cam[3] * dy + cam[6] * dz
        grad_means[i, 1] = cam[1] * dx + cam[4] * dy + cam[7] * dz
        grad_means[i, 2] = cam[2] * dx + cam[5] * dy + cam[8] * dz
