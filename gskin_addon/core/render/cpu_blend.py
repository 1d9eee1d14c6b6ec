# SPDX-License-Identifier: GPL-3.0-or-later
"""numba kernels that blend sorted splats into the pixels of a tile, forward and backward, eight pixels at a
time.

Per pixel, front to back: alpha_i = min(0.99, o_i exp(...)), nothing below 1/255; weight w_i = T_i alpha_i,
T_(i+1) = T_i (1 - alpha_i); blending stops before the splat that would take T below 1e-4. A stopped pixel
keeps its T negated, which is the whole bookkeeping.

The backward pass runs in the same order. With s the sum of what lies behind, s_i = sum_(j>i) w_j (g . c_j) +
T_end (g . background - g_alpha), dL/dalpha_i = T_i (g . c_i) - s_i / (1 - alpha_i); the first s is known from
the image, so T and s are all that a pixel carries.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, njit

from .cpu_project import LEAN, RY, TILE, WIDE, A, B, C, K
from .vec8 import (
    both,
    broadcast,
    exp2,
    fma,
    lane_index,
    lane_max,
    lane_sum,
    less,
    load,
    maximum,
    minimum,
    select,
    store,
)

LOG2_CUT = np.float32(np.log2(1.0 / 255.0))
ALPHA_MAX = np.float32(0.99)
T_MIN = np.float32(1e-4)

STRIDE = TILE + 8
"""A row of a tile's state; the pixels beyond TILE count as stopped and let eight lanes start at any column."""

AREA = TILE * STRIDE


@njit(cache=True, nogil=True)
def _start_tile(T: Any, rows: int, columns: int) -> None:
    """T (AREA,) = 1 inside the image and the tile, stopped outside."""
    for y in range(TILE):
        for x in range(STRIDE):
            T[y * STRIDE + x] = 1.0 if y < rows and x < columns else -1.0


@njit(cache=True, nogil=True)
def _alive(T: Any) -> bool:
    """Whether any pixel of T (AREA,) still blends."""
    best = load(T, 0)
    for k in range(8, AREA, 8):
        best = maximum(best, load(T, k))
    return bool(lane_max(best) > 0.0)


@njit(cache=True, nogil=True)
def _pixel(image: Any, y: int, x: int) -> Any:
    return image[y, x, 0], image[y, x, 1], image[y, x, 2]


@njit(cache=True, nogil=True)
def forward_tiles(
    lo: int, hi: int, pixels: Any, record: Any, colors: Any, background: Any, tile_start: Any, slots: Any, owner: Any,
    image: Any, alpha: Any, weight: Any,
) -> None:  # fmt: skip
    """Blend the splats of tiles lo..hi into image (H,W,3) and alpha (H,W).

    `weight` (pairs,), when not empty, takes each (splat, tile) pair's largest blending weight.
    """
    height, width = alpha.shape
    grid = (width + TILE - 1) // TILE
    state = np.empty((4, AREA), np.float32)
    T, red, green, blue = state[0], state[1], state[2], state[3]
    zero, one, cut = broadcast(float32(0.0)), broadcast(float32(1.0)), broadcast(LOG2_CUT)
    top, least, lanes, step = broadcast(ALPHA_MAX), broadcast(T_MIN), lane_index(), broadcast(float32(8.0))
    for tile in range(lo, hi):
        x0, y0 = tile % grid * TILE, tile // grid * TILE
        columns, rows = min(TILE, width - x0), min(TILE, height - y0)
        first, last = tile_start[tile], tile_start[tile + 1]
        _start_tile(T, rows, columns)
        state[1:] = 0.0
        for e in range(first, last):
            if (e - first) & 63 == 63 and not _alive(T):
                break
            slot = slots[e]
            i = owner[slot]
            cr, cg, cb = broadcast(colors[i, 0]), broadcast(colors[i, 1]), broadcast(colors[i, 2])
            mx, my = float32(pixels[i, 0] - (x0 + 0.5)), float32(pixels[i, 1] - (y0 + 0.5))
            a, b, c, k = record[i, A], record[i, B], record[i, C], record[i, K]
            wide, lean = record[i, WIDE], record[i, LEAN]
            va = broadcast(-a)
            best = zero
            for y in range(
                max(int(np.ceil(my - record[i, RY])), 0), min(int(np.floor(my + record[i, RY])) + 1, rows)
            ):
                dy = float32(y) - my
                ridge = mx - lean * dy
                xa, xb = max(int(np.ceil(ridge - wide)), 0), min(int(np.floor(ridge + wide)) + 1, columns)
                vb, vk = broadcast(-b * dy), broadcast(k - c * dy * dy)
                dx = lanes + broadcast(float32(xa) - mx)
                for x in range(xa, xb, 8):
                    at = y * STRIDE + x
                    t = load(T, at)
                    power = fma(fma(va, dx, vb), dx, vk)
                    opaque = minimum(exp2(power), top)
                    drawn = both(less(cut, power), less(zero, t))
                    left = t * (one - opaque)
                    goes_on = both(drawn, less(least, left))
                    w = select(goes_on, t * opaque, zero)
                    store(T, at, select(goes_on, left, select(drawn, zero - t, t)))
                    store(red, at, fma(w, cr, load(red, at)))
                    store(green, at, fma(w, cg, load(green, at)))
                    store(blue, at, fma(w, cb, load(blue, at)))
                    best = maximum(best, w)
                    dx = dx + step
            if weight.size > 0:
                weight[slot] = lane_max(best)
        for y in range(rows):
            for x in range(columns):
                at = y * STRIDE + x
                t = abs(T[at])
                alpha[y0 + y, x0 + x] = float32(1.0) - t
                image[y0 + y, x0 + x, 0] = red[at] + t * background[0]
                image[y0 + y, x0 + x, 1] = green[at] + t * background[1]
                image[y0 + y, x0 + x, 2] = blue[at] + t * background[2]


@njit(cache=True, nogil=True)
def backward_tiles(
    lo: int, hi: int, pixels: Any, record: Any, colors: Any, tile_start: Any, slots: Any, owner: Any, image: Any,
    alpha: Any, grad_image: Any, grad_alpha: Any, partial: Any,
) -> None:  # fmt: skip
    """Fill `partial` (pairs,6) of tiles lo..hi; see project_backward.

    grad_image (H,W,3) and grad_alpha (H,W; empty for none) are the gradients of the loss to the images.
    """
    height, width = alpha.shape
    grid = (width + TILE - 1) // TILE
    state = np.zeros((5, AREA), np.float32)
    T, S, red, green, blue = state[0], state[1], state[2], state[3], state[4]
    zero, one, cut = broadcast(float32(0.0)), broadcast(float32(1.0)), broadcast(LOG2_CUT)
    top, least, lanes, step = broadcast(ALPHA_MAX), broadcast(T_MIN), lane_index(), broadcast(float32(8.0))
    for tile in range(lo, hi):
        x0, y0 = tile % grid * TILE, tile // grid * TILE
        columns, rows = min(TILE, width - x0), min(TILE, height - y0)
        first, last = tile_start[tile], tile_start[tile + 1]
        if first == last:
            continue
        _start_tile(T, rows, columns)
        for y in range(rows):
            for x in range(columns):
                at = y * STRIDE + x
                gr, gg, gb = _pixel(grad_image, y0 + y, x0 + x)
                red[at], green[at], blue[at] = gr, gg, gb
                ir, ig, ib = _pixel(image, y0 + y, x0 + x)
                S[at] = gr * ir + gg * ig + gb * ib
                if grad_alpha.size > 0:
                    S[at] -= grad_alpha[y0 + y, x0 + x] * (float32(1.0) - alpha[y0 + y, x0 + x])
        dead = False
        for e in range(first, last):
            slot = slots[e]
            dead = dead or ((e - first) & 63 == 63 and not _alive(T))
            if dead:
                for n in range(6):
                    partial[slot, n] = 0.0
                continue
            i = owner[slot]
            cr, cg, cb = broadcast(colors[i, 0]), broadcast(colors[i, 1]), broadcast(colors[i, 2])
            mx, my = float32(pixels[i, 0] - (x0 + 0.5)), float32(pixels[i, 1] - (y0 + 0.5))
            a, b, c, k = record[i, A], record[i, B], record[i, C], record[i, K]
            wide, lean = record[i, WIDE], record[i, LEAN]
            va = broadcast(-a)
            s0, sx, sy, sxx, sxy, syy = zero, zero, zero, zero, zero, zero
            for y in range(
                max(int(np.ceil(my - record[i, RY])), 0), min(int(np.floor(my + record[i, RY])) + 1, rows)
            ):
                dy = float32(y) - my
                ridge = mx - lean * dy
                xa, xb = max(int(np.ceil(ridge - wide)), 0), min(int(np.floor(ridge + wide)) + 1, columns)
                vb, vk, vy = broadcast(-b * dy), broadcast(k - c * dy * dy), broadcast(dy)
                dx = lanes + broadcast(float32(xa) - mx)
                for x in range(xa, xb, 8):
                    at = y * STRIDE + x
                    t = load(T, at)
                    power = fma(fma(va, dx, vb), dx, vk)
                    raw = exp2(power)
                    opaque = minimum(raw, top)
                    drawn = both(less(cut, power), less(zero, t))
                    clear = one - opaque
                    left = t * clear
                    goes_on = both(drawn, less(least, left))
                    store(T, at, select(goes_on, left, select(drawn, zero - t, t)))
                    gc = fma(cb, load(blue, at), fma(cg, load(green, at), cr * load(red, at)))
                    w = select(goes_on, t * opaque, zero)
                    behind = load(S, at) - w * gc
                    store(S, at, behind)
                    v = select(both(goes_on, less(raw, top)), opaque * (t * gc - behind / clear), zero)
                    vx, yv = v * dx, v * vy
                    s0, sx, sy = s0 + v, sx + vx, sy + yv
                    sxx, sxy, syy = fma(vx, dx, sxx), fma(vx, vy, sxy), fma(yv, vy, syy)
                    dx = dx + step
            partial[slot, 0] = lane_sum(s0)
            partial[slot, 1] = lane_sum(sx)
            partial[slot, 2] = lane_sum(sy)
            partial[slot, 3] = lane_sum(sxx)
            partial[slot, 4] = lane_sum(sxy)
            partial[slot, 5] = lane_sum(syy)
