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

from .cpu_project import MX, MY, RY, TILE, A, B, C, K
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
LN2 = np.float32(np.log(2.0))


@njit(cache=True, nogil=True)
def _rows(r: Any, y0: int, rows: int) -> Any:
    """First and last+1 row of the tile that the splat's record `r` reaches."""
    my = r[MY] - y0 - 0.5
    return max(int(np.ceil(my - r[RY] - 0.001)), 0), min(int(np.floor(my + r[RY] + 0.001)) + 1, rows)


@njit(cache=True, nogil=True)
def _start_tile(T: Any, rows: int, columns: int) -> None:
    """T (TILE*TILE,) = 1 inside the image, stopped outside."""
    for y in range(TILE):
        for x in range(TILE):
            T[y * TILE + x] = 1.0 if y < rows and x < columns else -1.0


@njit(cache=True, nogil=True)
def _alive(T: Any) -> bool:
    best = load(T, 0)
    for k in range(8, TILE * TILE, 8):
        best = maximum(best, load(T, k))
    return lane_max(best) > 0.0


@njit(cache=True, nogil=True)
def forward_tiles(
    lo: int,
    hi: int,
    record: Any,
    colors: Any,
    background: Any,
    tile_start: Any,
    keys: Any,
    owner: Any,
    image: Any,
    alpha: Any,
    weight: Any,
) -> None:
    """Sort the keys of tiles lo..hi and blend them into image (H,W,3) and alpha (H,W).

    `weight` (pairs,), when not empty, takes each (splat, tile) pair's largest blending weight.
    """
    height, width = alpha.shape
    grid = (width + TILE - 1) // TILE
    T, red, green, blue = (
        np.empty(TILE * TILE, np.float32),
        np.empty(TILE * TILE, np.float32),
        np.empty(TILE * TILE, np.float32),
        np.empty(TILE * TILE, np.float32),
    )
    zero, one, cut, top, least = (
        broadcast(float32(0.0)),
        broadcast(float32(1.0)),
        broadcast(LOG2_CUT),
        broadcast(ALPHA_MAX),
        broadcast(T_MIN),
    )
    for tile in range(lo, hi):
        x0, y0 = tile % grid * TILE, tile // grid * TILE
        columns, rows = min(TILE, width - x0), min(TILE, height - y0)
        first, last = tile_start[tile], tile_start[tile + 1]
        keys[first:last].sort()
        _start_tile(T, rows, columns)
        red[:] = 0.0
        green[:] = 0.0
        blue[:] = 0.0
        for e in range(first, last):
            if (e - first) & 63 == 63 and not _alive(T):
                break
            slot = np.int64(keys[e] & np.uint64(0xFFFFFFFF))
            i = owner[slot]
            r = record[i]
            cr, cg, cb = broadcast(colors[i, 0]), broadcast(colors[i, 1]), broadcast(colors[i, 2])
            mx, my = r[MX] - x0 - 0.5, r[MY] - y0 - 0.5
            a, b, c, k = r[A], r[B], r[C], r[K]
            flat = c - b * b / (4.0 * a)  # along the ridge of the row maxima
            room = k - LOG2_CUT
            va = broadcast(float32(-a))
            ya, yb = _rows(r, y0, rows)
            best = zero
            for y in range(ya, yb):
                dy = y - my
                reach = np.sqrt(max(room - flat * dy * dy, 0.0) / a) + 0.001
                middle = mx - b * dy / (2.0 * a)
                if middle + reach < 0.0 or middle - reach > columns - 1:
                    continue
                xa = max(int(middle - reach), 0) & ~7
                xb = min(int(middle + reach) + 1, columns)
                vb, vk = broadcast(float32(-b * dy)), broadcast(float32(k - c * dy * dy))
                dx = lane_index() + broadcast(float32(xa - mx))
                for x in range(xa, xb, 8):
                    at = y * TILE + x
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
                    dx = dx + broadcast(float32(8.0))
            if weight.size > 0:
                weight[slot] = lane_max(best)
        for y in range(rows):
            for x in range(columns):
                at = y * TILE + x
                t = abs(T[at])
                alpha[y0 + y, x0 + x] = float32(1.0) - t
                image[y0 + y, x0 + x, 0] = red[at] + t * background[0]
                image[y0 + y, x0 + x, 1] = green[at] + t * background[1]
                image[y0 + y, x0 + x, 2] = blue[at] + t * background[2]


@njit(cache=True, nogil=True)
def backward_tiles(
    lo: int,
    hi: int,
    record: Any,
    colors: Any,
    tile_start: Any,
    keys: Any,
    owner: Any,
    image: Any,
    alpha: Any,
    grad_image: Any,
    grad_alpha: Any,
    partial: Any,
) -> None:
    """Fill `partial` (pairs,6) of tiles lo..hi (see project_backward) after forward_tiles has sorted the
    keys.

    grad_image (H,W,3) and grad_alpha (H,W; empty for none) are the gradients of the loss to the images.
    """
    height, width = alpha.shape
    grid = (width + TILE - 1) // TILE
    T, S = np.empty(TILE * TILE, np.float32), np.zeros(TILE * TILE, np.float32)
    red, green, blue = (
        np.zeros(TILE * TILE, np.float32),
        np.zeros(TILE * TILE, np.float32),
        np.zeros(TILE * TILE, np.float32),
    )
    zero, one, cut, top, least = (
        broadcast(float32(0.0)),
        broadcast(float32(1.0)),
        broadcast(LOG2_CUT),
        broadcast(ALPHA_MAX),
        broadcast(T_MIN),
    )
    for tile in range(lo, hi):
        x0, y0 = tile % grid * TILE, tile // grid * TILE
        columns, rows = min(TILE, width - x0), min(TILE, height - y0)
        first, last = tile_start[tile], tile_start[tile + 1]
        if first == last:
            continue
        _start_tile(T, rows, columns)
        for y in range(rows):
            for x in range(columns):
                at = y * TILE + x
                red[at] = grad_image[y0 + y, x0 + x, 0]
                green[at] = grad_image[y0 + y, x0 + x, 1]
                blue[at] = grad_image[y0 + y, x0 + x, 2]
                S[at] = (
                    red[at] * image[y0 + y, x0 + x, 0]
                    + green[at] * image[y0 + y, x0 + x, 1]
                    + blue[at] * image[y0 + y, x0 + x, 2]
                )
                if grad_alpha.size > 0:
                    S[at] -= grad_alpha[y0 + y, x0 + x] * (float32(1.0) - alpha[y0 + y, x0 + x])
        dead = False
        for e in range(first, last):
            slot = np.int64(keys[e] & np.uint64(0xFFFFFFFF))
            dead = dead or ((e - first) & 63 == 63 and not _alive(T))
            if dead:
                for n in range(6):
                    partial[slot, n] = 0.0
                continue
            i = owner[slot]
            r = record[i]
            cr, cg, cb = broadcast(colors[i, 0]), broadcast(colors[i, 1]), broadcast(colors[i, 2])
            mx, my = r[MX] - x0 - 0.5, r[MY] - y0 - 0.5
            a, b, c, k = r[A], r[B], r[C], r[K]
            flat = c - b * b / (4.0 * a)
            room = k - LOG2_CUT
            va = broadcast(float32(-a))
            ya, yb = _rows(r, y0, rows)
            s0, sx, sy, sxx, sxy, syy = zero, zero, zero, zero, zero, zero
            for y in range(ya, yb):
                dy = y - my
                reach = np.sqrt(max(room - flat * dy * dy, 0.0) / a) + 0.001
                middle = mx - b * dy / (2.0 * a)
                if middle + reach < 0.0 or middle - reach > columns - 1:
                    continue
                xa = max(int(middle - reach), 0) & ~7
                xb = min(int(middle + reach) + 1, columns)
                vb, vk, vy = (
                    broadcast(float32(-b * dy)),
                    broadcast(float32(k - c * dy * dy)),
                    broadcast(float32(dy)),
                )
                dx = lane_index() + broadcast(float32(xa - mx))
                for x in range(xa, xb, 8):
                    at = y * TILE + x
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
                    vx = v * dx
                    yv = v * vy
                    s0, sx, sy = s0 + v, sx + vx, sy + yv
                    sxx, sxy, syy = fma(vx, dx, sxx), fma(vx, vy, sxy), fma(yv, vy, syy)
                    dx = dx + broadcast(float32(8.0))
            partial[slot, 0] = lane_sum(s0)
            partial[slot, 1] = lane_sum(sx)
            partial[slot, 2] = lane_sum(sy)
            partial[slot, 3] = lane_sum(sxx)
            partial[slot, 4] = lane_sum(sxy)
            partial[slot, 5] = lane_sum(syy)
