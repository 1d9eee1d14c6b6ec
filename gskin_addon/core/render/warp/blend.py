# SPDX-License-Identifier: GPL-3.0-or-later
"""Warp kernels that blend sorted splats into pixels, forward and backward; see cpu/blend.py for the equations.

A tile of 16 x 16 pixels belongs to the 32 threads of one hardware warp: a thread has eight pixels of a column, in
registers, and adds up their gradients before the warp does. So there is one sum per splat and tile, written once:
no atomics, and the same numbers in every run. On the "cpu" device the 32 lanes run one after the other and add.
"""

from __future__ import annotations

import warp as wp

from .project import TILE, Floats, Ints, Sums, sums6
from .tiles import Records

wp.set_module_options({"enable_backward": False})

LANES = 32
PIXELS = TILE * TILE // LANES
"""Pixels of a thread: rows (lane // 16) + 2 k of the column lane % 16."""

lane_t = wp.types.vector(length=PIXELS, dtype=wp.float32)

Images, Masks = wp.array4d(dtype=wp.float32), wp.array3d(dtype=wp.float32)

_TILE, _LANES, _PIXELS = wp.constant(TILE), wp.constant(LANES), wp.constant(PIXELS)
_LN_CUT = wp.constant(wp.float32(-5.541263545158426))
_ALPHA_MAX = wp.constant(wp.float32(0.99))
_T_MIN = wp.constant(wp.float32(1e-4))


@wp.func_native("""
    float total = value;
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1)
        total += __shfl_xor_sync(0xffffffffu, total, step);
#endif
    return total;
""")
def lane_sum(value: wp.float32) -> wp.float32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, value) ? 1 : 0;
#else
    return value;
#endif
""")
def lane_any(value: wp.int32) -> wp.int32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return lane == 0 ? 1 : 0;
#else
    return 1;
#endif
""")
def lane_writes(lane: wp.int32) -> wp.int32: ...


@wp.func
def open_pixels(x: int, y: int, width: int, height: int):
    """Transmittance 1 of a thread's pixels within the image, -1 (stopped) outside."""
    T = lane_t()
    for k in range(_PIXELS):
        T[k] = -1.0
        if x < width and y + 2 * k < height:
            T[k] = 1.0
    return T


@wp.kernel
def blend(
    columns: int, rows: int, width: int, height: int, start: Ints, records: Records, background: wp.vec3,
    slots: Ints, owner: Ints, image: Images, alpha: Masks, most: Floats,
) -> None:  # fmt: skip
    """image (P,H,W,3) and alpha (P,H,W); `most` (P*N,), when not empty, takes each splat's largest weight."""
    t = wp.tid()
    tile = t // _LANES
    lane = t - tile * _LANES
    p = tile // (columns * rows)
    column = lane % _TILE
    row = lane // _TILE
    x = tile % columns * _TILE + column
    y = tile // columns % rows * _TILE + row
    T = open_pixels(x, y, width, height)
    red = lane_t()
    green = lane_t()
    blue = lane_t()
    first = start[tile]
    for r in range(first, start[tile + 1]):
        if (r - first) % 16 == 0 and lane_any(wp.where(wp.max(T) > 0.0, 1, 0)) == 0:
            break
        s = records[r]
        dx = float(column) - s[0]
        top = s[1] - s[2]
        bottom = s[1] + s[2]
        fixed = s[6] - s[3] * dx * dx
        slope = s[4] * dx
        best = float(0.0)
        for k in range(_PIXELS):
            if float(2 * k + 1) >= top and float(2 * k) <= bottom:
                dy = float(row + 2 * k) - s[1]
                power = fixed - (slope + s[5] * dy) * dy
                if power > _LN_CUT and T[k] > 0.0:
                    opaque = wp.min(wp.exp(power), _ALPHA_MAX)
                    left = T[k] * (1.0 - opaque)
                    if left > _T_MIN:
                        w = T[k] * opaque
                        red[k] = red[k] + w * s[7]
                        green[k] = green[k] + w * s[8]
                        blue[k] = blue[k] + w * s[9]
                        T[k] = left
                        best = wp.max(best, w)
                    else:
                        T[k] = -T[k]
        if most.shape[0] > 0 and best > 0.0:
            wp.atomic_max(most, owner[slots[r]], best)
    for k in range(_PIXELS):
        yk = y + 2 * k
        if x < width and yk < height:
            t_end = wp.abs(T[k])
            alpha[p, yk, x] = 1.0 - t_end
            image[p, yk, x, 0] = red[k] + t_end * background[0]
            image[p, yk, x, 1] = green[k] + t_end * background[1]
            image[p, yk, x, 2] = blue[k] + t_end * background[2]


@wp.kernel
def blend_backward(
    columns: int, rows: int, width: int, height: int, start: Ints, records: Records, slots: Ints, image: Images,
    alpha: Masks, grad_image: Images, grad_alpha: Masks, partial: Sums,
) -> None:  # fmt: skip
    """Add to `partial` (pairs,), zero before, the sums of every (splat, tile) pair; see project.sums6.

    grad_image (P,H,W,3) and grad_alpha (P,H,W; empty for none) are the gradients of the loss to the images.
    """
    t = wp.tid()
    tile = t // _LANES
    lane = t - tile * _LANES
    p = tile // (columns * rows)
    column = lane % _TILE
    row = lane // _TILE
    x = tile % columns * _TILE + column
    y = tile // columns % rows * _TILE + row
    first = start[tile]
    last = start[tile + 1]
    if first == last:
        return
    T = open_pixels(x, y, width, height)
    S = lane_t()
    red = lane_t()
    green = lane_t()
    blue = lane_t()
    for k in range(_PIXELS):
        yk = y + 2 * k
        if x < width and yk < height:
            red[k] = grad_image[p, yk, x, 0]
            green[k] = grad_image[p, yk, x, 1]
            blue[k] = grad_image[p, yk, x, 2]
            S[k] = red[k] * image[p, yk, x, 0] + green[k] * image[p, yk, x, 1] + blue[k] * image[p, yk, x, 2]
            if grad_alpha.shape[0] > 0:
                S[k] = S[k] - grad_alpha[p, yk, x] * (1.0 - alpha[p, yk, x])
    for r in range(first, last):
        if (r - first) % 16 == 0 and lane_any(wp.where(wp.max(T) > 0.0, 1, 0)) == 0:
            break
        s = records[r]
        dx = float(column) - s[0]
        top = s[1] - s[2]
        bottom = s[1] + s[2]
        fixed = s[6] - s[3] * dx * dx
        slope = s[4] * dx
        v0 = float(0.0)
        vy = float(0.0)
        vyy = float(0.0)
        for k in range(_PIXELS):
            if float(2 * k + 1) >= top and float(2 * k) <= bottom:
                dy = float(row + 2 * k) - s[1]
                power = fixed - (slope + s[5] * dy) * dy
                if power > _LN_CUT and T[k] > 0.0:
                    raw = wp.exp(power)
                    opaque = wp.min(raw, _ALPHA_MAX)
                    clear = 1.0 - opaque
                    left = T[k] * clear
                    if left > _T_MIN:
                        gc = red[k] * s[7] + green[k] * s[8] + blue[k] * s[9]
                        behind = S[k] - T[k] * opaque * gc
                        S[k] = behind
                        if raw < _ALPHA_MAX:
                            v = opaque * (T[k] * gc - behind / clear)
                            v0 += v
                            vy += v * dy
                            vyy += v * dy * dy
                        T[k] = left
                    else:
                        T[k] = -T[k]
        if lane_any(wp.where(v0 != 0.0 or vy != 0.0 or vyy != 0.0, 1, 0)) != 0:
            vx = v0 * dx
            total = sums6(
                lane_sum(v0), lane_sum(vx), lane_sum(vy), lane_sum(vx * dx), lane_sum(vy * dx), lane_sum(vyy)
            )
            if lane_writes(lane) != 0:
                slot = slots[r]
                partial[slot] = partial[slot] + total
