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

# Columns of the per-splat record: log2(alpha) = K - A dx^2 - B dx dy - C dy^2 around the mean (MX, MY), in
# pixels, for pixels with |dy| <= RY.
MX, MY, A, B, C, K, RY, RECORD = 0, 1, 2, 3, 4, 5, 6, 7

CAMERA = 24
"""Length of the vector that the kernels read: rotation 0-8, translation 9-11, fx fy near 12-14, slope
bounds x/z 16-17 and y/z 18-19, dilation 20, compensation 21 (negative for none), cx cy 22-23."""


@njit(cache=True, nogil=True, inline="never")
def _project_one(p: Any, q: Any, s: Any, cam: Any) -> Any:
    """Camera point, unit quaternion, 1 / its norm, clamped slopes, R, T = J W and U = J W R diag(s)."""
    x = cam[0] * p[0] + cam[1] * p[1] + cam[2] * p[2] + cam[9]
    y = cam[3] * p[0] + cam[4] * p[1] + cam[5] * p[2] + cam[10]
    z = cam[6] * p[0] + cam[7] * p[1] + cam[8] * p[2] + cam[11]
    norm = np.sqrt(
        np.float64(q[0]) * q[0] + np.float64(q[1]) * q[1] + np.float64(q[2]) * q[2] + np.float64(q[3]) * q[3]
    )
    inverse = 1.0 / norm if norm > 0.0 else 0.0
    w, a, b, c = q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse
    R = (
        1 - 2 * (b * b + c * c),
        2 * (a * b - w * c),
        2 * (a * c + w * b),
        2 * (a * b + w * c),
        1 - 2 * (a * a + c * c),
        2 * (b * c - w * a),
        2 * (a * c - w * b),
        2 * (b * c + w * a),
        1 - 2 * (a * a + b * b),
    )
    iz = 1.0 / z if z != 0.0 else 0.0
    # The slope is clamped in J only, so that splats beside the image do not blow up (as INRIA and gsplat do).
    u = min(max(x * iz, cam[16]), cam[17])
    v = min(max(y * iz, cam[18]), cam[19])
    j00, j02, j11, j12 = cam[12] * iz, -cam[12] * u * iz, cam[13] * iz, -cam[13] * v * iz
    T = (
        j00 * cam[0] + j02 * cam[6],
        j00 * cam[1] + j02 * cam[7],
        j00 * cam[2] + j02 * cam[8],
        j11 * cam[3] + j12 * cam[6],
        j11 * cam[4] + j12 * cam[7],
        j11 * cam[5] + j12 * cam[8],
    )
    U = (
        (T[0] * R[0] + T[1] * R[3] + T[2] * R[6]) * s[0],
        (T[0] * R[1] + T[1] * R[4] + T[2] * R[7]) * s[1],
        (T[0] * R[2] + T[1] * R[5] + T[2] * R[8]) * s[2],
        (T[3] * R[0] + T[4] * R[3] + T[5] * R[6]) * s[0],
        (T[3] * R[1] + T[4] * R[4] + T[5] * R[7]) * s[1],
        (T[3] * R[2] + T[4] * R[5] + T[5] * R[8]) * s[2],
    )
    return (x, y, z), (w, a, b, c), inverse, (u, v), R, T, U


@njit(cache=True, nogil=True, inline="never")
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
    lo: int,
    hi: int,
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    cam: Any,
    width: int,
    height: int,
    record: Any,
    depth: Any,
    rect: Any,
    tiles: Any,
) -> None:
    """Fill record (N,RECORD), depth (N,), rect (N,4) = tile columns and rows [x0, x1) x [y0, y1), and the
    number of tiles (N,) of splats lo..hi; a splat that shows nowhere gets 0 tiles. The extent is exact: alpha
    >= 1/255."""
    dilation, compensate = cam[20], cam[21]
    for i in range(lo, hi):
        tiles[i] = 0
        if not opacities[i] >= ALPHA_CUT:
            continue
        point, _q, inverse, _uv, _R, _T, U = _project_one(means[i], quats[i], scales[i], cam)
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
        record[i, MX], record[i, MY] = mx, my
        record[i, A], record[i, B], record[i, C] = yy * half, -2.0 * xy * half, xx * half
        record[i, K], record[i, RY] = np.log2(opacity), ry


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
def fill_tiles(
    rect: Any, tiles: Any, depth_bits: Any, columns: int, tile_start: Any, cursor: Any, keys: Any, owner: Any
) -> None:
    """keys (pairs,) uint64 per tile = depth bits << 32 | slot, in splat order; owner (pairs,): splat of each
    slot.

    The bits of a positive float sort like the float, and the slot breaks ties by splat index.
    """
    cursor[:] = tile_start[:-1]
    slot = 0
    for i in range(tiles.shape[0]):
        if tiles[i] > 0:
            key = np.uint64(depth_bits[i]) << np.uint64(32)
            for ty in range(rect[i, 2], rect[i, 3]):
                for tx in range(rect[i, 0], rect[i, 1]):
                    t = ty * columns + tx
                    keys[cursor[t]] = key | np.uint64(slot)
                    owner[slot] = i
                    cursor[t] += 1
                    slot += 1


@njit(cache=True, nogil=True)
def project_backward(
    lo: int,
    hi: int,
    means: Any,
    quats: Any,
    scales: Any,
    cam: Any,
    record: Any,
    first_slot: Any,
    partial: Any,
    grad_means: Any,
    grad_quats: Any,
) -> None:
    """Gradients to means (N,3) and quats (N,4) of splats lo..hi from the tiles' sums `partial` (pairs,6).

    The columns of `partial` are sums over pixels of v, v dx, v dy, v dx^2, v dx dy, v dy^2 with v = alpha
    dL/dalpha and (dx, dy) the pixel minus the mean.
    """
    dilation, compensate = cam[20], cam[21]
    for i in range(lo, hi):
        g = np.zeros(6)
        for slot in range(first_slot[i], first_slot[i + 1]):
            for k in range(6):
                g[k] += partial[slot, k]
        if g[0] == 0.0 and g[1] == 0.0 and g[2] == 0.0 and g[3] == 0.0 and g[5] == 0.0:
            grad_means[i, :] = 0.0
            grad_quats[i, :] = 0.0
            continue
        point, q, inverse, uv, R, T, U = _project_one(means[i], quats[i], scales[i], cam)
        xx, xy, yy, det = _covariance(U, dilation)
        a, b, c = yy / det, -xy / det, xx / det  # inverse covariance
        # ln alpha = ln o - (a dx^2 + 2 b dx dy + c dy^2) / 2
        gx, gy = a * g[1] + b * g[2], b * g[1] + c * g[2]
        # dL/dcovariance = inverse (sum v d d^T) inverse / 2
        px, py, qx, qy = a * g[3] + b * g[4], a * g[4] + b * g[5], b * g[3] + c * g[4], b * g[4] + c * g[5]
        hxx, hxy, hyy = 0.5 * (px * a + py * b), 0.5 * (px * b + py * c), 0.5 * (qx * b + qy * c)
        if compensate >= 0.0:
            exx, exy, eyy, edet = _covariance(U, compensate)
            if edet > 0.0:
                # d ln sqrt(det(S + e) / det(S + dilation)) / dS
                hxx += 0.5 * g[0] * (eyy / edet - a)
                hxy += 0.5 * g[0] * (-exy / edet - b)
                hyy += 0.5 * g[0] * (exx / edet - c)
        # dL/dU = 2 H U, then U = T V with V = R diag(s)
        d = np.empty((2, 3))
        for k in range(3):
            d[0, k] = 2.0 * (hxx * U[k] + hxy * U[k + 3])
            d[1, k] = 2.0 * (hxy * U[k] + hyy * U[k + 3])
        t = np.empty((2, 3))  # dL/dT = dL/dU V^T
        for k in range(3):
            for r in range(2):
                t[r, k] = (
                    d[r, 0] * R[3 * k] * scales[i, 0]
                    + d[r, 1] * R[3 * k + 1] * scales[i, 1]
                    + d[r, 2] * R[3 * k + 2] * scales[i, 2]
                )
        G = np.empty((3, 3))  # dL/dR = T^T dL/dU diag(s)
        for r in range(3):
            for k in range(3):
                G[r, k] = (T[r] * d[0, k] + T[r + 3] * d[1, k]) * scales[i, k]
        w, x, y, z = q
        gw = 2 * (z * (G[1, 0] - G[0, 1]) + y * (G[0, 2] - G[2, 0]) + x * (G[2, 1] - G[1, 2]))
        ga = 2 * (
            y * (G[0, 1] + G[1, 0])
            + z * (G[0, 2] + G[2, 0])
            + w * (G[2, 1] - G[1, 2])
            - 2 * x * (G[1, 1] + G[2, 2])
        )
        gb = 2 * (
            x * (G[0, 1] + G[1, 0])
            + z * (G[1, 2] + G[2, 1])
            + w * (G[0, 2] - G[2, 0])
            - 2 * y * (G[0, 0] + G[2, 2])
        )
        gc = 2 * (
            x * (G[0, 2] + G[2, 0])
            + y * (G[1, 2] + G[2, 1])
            + w * (G[1, 0] - G[0, 1])
            - 2 * z * (G[0, 0] + G[1, 1])
        )
        along = gw * w + ga * x + gb * y + gc * z  # the kernel normalises the quaternion
        grad_quats[i, 0] = (gw - along * w) * inverse
        grad_quats[i, 1] = (ga - along * x) * inverse
        grad_quats[i, 2] = (gb - along * y) * inverse
        grad_quats[i, 3] = (gc - along * z) * inverse

        # T = J W: dL/dJ, of which only four entries can be other than zero
        j00 = t[0, 0] * cam[0] + t[0, 1] * cam[1] + t[0, 2] * cam[2]
        j02 = t[0, 0] * cam[6] + t[0, 1] * cam[7] + t[0, 2] * cam[8]
        j11 = t[1, 0] * cam[3] + t[1, 1] * cam[4] + t[1, 2] * cam[5]
        j12 = t[1, 0] * cam[6] + t[1, 1] * cam[7] + t[1, 2] * cam[8]
        iz = 1.0 / point[2]
        fx, fy = cam[12] * iz, cam[13] * iz
        dx, dy = fx * gx, fy * gy
        dz = (
            -iz * (dx * point[0] + dy * point[1])
            - iz * (fx * j00 + fy * j11)
            + iz * (fx * uv[0] * j02 + fy * uv[1] * j12)
        )
        if point[0] * iz == uv[0]:  # not clamped
            dx -= fx * iz * j02
            dz += fx * iz * uv[0] * j02
        if point[1] * iz == uv[1]:
            dy -= fy * iz * j12
            dz += fy * iz * uv[1] * j12
        grad_means[i, 0] = cam[0] * dx + cam[3] * dy + cam[6] * dz
        grad_means[i, 1] = cam[1] * dx + cam[4] * dy + cam[7] * dz
        grad_means[i, 2] = cam[2] * dx + cam[5] * dy + cam[8] * dz
