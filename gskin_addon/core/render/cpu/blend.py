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

from .project import LEAN, RECORD, RY, TILE, WIDE, A, B, C, K
from .vec8 import (
    any_lane,
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
"""A row of a tile's state. The pixels beyond TILE count as stopped, so eight lanes may start at any column from -8
(the end of the row before) to TILE."""

ORIGIN = 8
AREA = ORIGIN + TILE * STRIDE

FIRST_X, LAST_X, EIGHT, ONE = np.float32(-8), np.float32(TILE), np.float32(8), np.float32(1)

BLOCK = 64
"""Splats whose data is fetched at once, so that the waits for memory overlap."""

RED, GREEN, BLUE, MX, MY = RECORD, RECORD + 1, RECORD + 2, RECORD + 3, RECORD + 4
FETCHED = RECORD + 5


@njit(cache=True, nogil=True)
def _fetch(slots: Any, owner: Any, pixels: Any, record: Any, colors: Any, x0: int, y0: int, block: Any) -> None:
    """block (BLOCK,FETCHED): record, colour and mean of each slot's splat, in pixel centres from (x0, y0)."""
    for j in range(slots.shape[0]):
        i = owner[slots[j]]
        for n in range(RECORD):
            block[j, n] = record[i, n]
        block[j, RED], block[j, GREEN], block[j, BLUE] = colors[i, 0], colors[i, 1], colors[i, 2]
        block[j, MX], block[j, MY] = pixels[i, 0] - (x0 + 0.5), pixels[i, 1] - (y0 + 0.5)


@njit(cache=True, nogil=True)
def _start_tile(T: Any, rows: int, columns: int) -> None:
    """T (AREA,) = 1 inside the image and the tile, stopped outside."""
    T[:] = -1.0
    for y in range(rows):
        T[ORIGIN + y * STRIDE : ORIGIN + y * STRIDE + columns] = 1.0


@njit(cache=True, nogil=True)
def _alive(T: Any) -> bool:
    """Whether any pixel of T (AREA,) still blends."""
    best = load(T, 0)
    for k in range(8, AREA, 8):
        best = maximum(best, load(T, k))
    return bool(lane_max(best) > 0.0)


@njit(cache=True, nogil=True)
def _rows(my: Any, reach: Any, rows: int) -> Any:
    """Rows [first, last) of the tile that a splat reaches."""
    return max(np.int64(np.ceil(my - reach)), 0), min(np.int64(np.floor(my + reach)) + 1, rows)


@njit(cache=True, nogil=True)
def _strips(mx: Any, my: Any, wide: Any, lean: Any, ya: int, yb: int) -> Any:
    """First and last offset, multiples of 8 from the left end of each row, of the strips that meet the tile."""
    top, bottom = mx - lean * (float32(ya) - my) - wide, mx - lean * (float32(yb - 1) - my) - wide
    first = EIGHT * np.floor((FIRST_X - max(top, bottom)) / EIGHT)
    return max(first, float32(0.0)), min(wide + wide, LAST_X - min(top, bottom))


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
    state, block = np.empty((4, AREA), np.float32), np.empty((BLOCK, FETCHED), np.float32)
    T, red, green, blue = state[0], state[1], state[2], state[3]
    zero, one, cut = broadcast(float32(0.0)), broadcast(float32(1.0)), broadcast(LOG2_CUT)
    top, least, lanes = broadcast(ALPHA_MAX), broadcast(T_MIN), lane_index()
    for tile in range(lo, hi):
        x0, y0 = tile % grid * TILE, tile // grid * TILE
        columns, rows = min(TILE, width - x0), min(TILE, height - y0)
        first, last = tile_start[tile], tile_start[tile + 1]
        _start_tile(T, rows, columns)
        state[1:] = 0.0
        for start in range(first, last, BLOCK):
            if start > first and not _alive(T):
                break
            ours = slots[start : min(start + BLOCK, last)]
            _fetch(ours, owner, pixels, record, colors, x0, y0, block)
            for j in range(ours.shape[0]):
                cr, cg, cb = broadcast(block[j, RED]), broadcast(block[j, GREEN]), broadcast(block[j, BLUE])
                mx, my, reach, wide, lean = block[j, MX], block[j, MY], block[j, RY], block[j, WIDE], block[j, LEAN]
                a, b, c, k = block[j, A], block[j, B], block[j, C], block[j, K]
                va = broadcast(-a)
                best = zero
                ya, yb = _rows(my, reach, rows)
                # Strips of eight columns that follow the ridge; most splats need one.
                strip, end = _strips(mx, my, wide, lean, ya, yb)
                while strip <= end:
                    dy = float32(ya) - my
                    for y in range(ya, yb):
                        begin = min(max(np.ceil(mx - lean * dy - wide) + strip, FIRST_X), LAST_X)
                        at = ORIGIN + y * STRIDE + int(begin)
                        dx = lanes + broadcast(begin - mx)
                        t = load(T, at)
                        power = fma(fma(va, dx, broadcast(-b * dy)), dx, broadcast(k - c * dy * dy))
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
                        dy += ONE
                    strip += EIGHT
                if weight.size > 0:
                    weight[ours[j]] = lane_max(best)
        for y in range(rows):
            for x in range(columns):
                at = ORIGIN + y * STRIDE + x
                t = abs(T[at])
                alpha[y0 + y, x0 + x] = ONE - t
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
    state, block = np.zeros((5, AREA), np.float32), np.empty((BLOCK, FETCHED), np.float32)
    T, S, red, green, blue = state[0], state[1], state[2], state[3], state[4]
    zero, one, cut = broadcast(float32(0.0)), broadcast(float32(1.0)), broadcast(LOG2_CUT)
    top, least, lanes = broadcast(ALPHA_MAX), broadcast(T_MIN), lane_index()
    for tile in range(lo, hi):
        x0, y0 = tile % grid * TILE, tile // grid * TILE
        columns, rows = min(TILE, width - x0), min(TILE, height - y0)
        first, last = tile_start[tile], tile_start[tile + 1]
        if first == last:
            continue
        _start_tile(T, rows, columns)
        for y in range(rows):
            for x in range(columns):
                at = ORIGIN + y * STRIDE + x
                gr, gg, gb = _pixel(grad_image, y0 + y, x0 + x)
                red[at], green[at], blue[at] = gr, gg, gb
                ir, ig, ib = _pixel(image, y0 + y, x0 + x)
                S[at] = gr * ir + gg * ig + gb * ib
                if grad_alpha.size > 0:
                    S[at] -= grad_alpha[y0 + y, x0 + x] * (ONE - alpha[y0 + y, x0 + x])
        for start in range(first, last, BLOCK):
            if start > first and not _alive(T):
                for e in range(start, last):
                    for n in range(6):
                        partial[slots[e], n] = 0.0
                break
            ours = slots[start : min(start + BLOCK, last)]
            _fetch(ours, owner, pixels, record, colors, x0, y0, block)
            for j in range(ours.shape[0]):
                cr, cg, cb = broadcast(block[j, RED]), broadcast(block[j, GREEN]), broadcast(block[j, BLUE])
                mx, my, reach, wide, lean = block[j, MX], block[j, MY], block[j, RY], block[j, WIDE], block[j, LEAN]
                a, b, c, k = block[j, A], block[j, B], block[j, C], block[j, K]
                va = broadcast(-a)
                s0, sx, sy, sxx, sxy, syy = zero, zero, zero, zero, zero, zero
                ya, yb = _rows(my, reach, rows)
                strip, end = _strips(mx, my, wide, lean, ya, yb)
                while strip <= end:
                    dy = float32(ya) - my
                    for y in range(ya, yb):
                        begin = min(max(np.ceil(mx - lean * dy - wide) + strip, FIRST_X), LAST_X)
                        at = ORIGIN + y * STRIDE + int(begin)
                        dx, vy = lanes + broadcast(begin - mx), broadcast(dy)
                        t = load(T, at)
                        if not any_lane(less(zero, t)):  # hidden; pays off on captures of solid things
                            dy += ONE
                            continue
                        power = fma(fma(va, dx, broadcast(-b * dy)), dx, broadcast(k - c * dy * dy))
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
                        dy += ONE
                    strip += EIGHT
                slot = ours[j]
                partial[slot, 0], partial[slot, 1], partial[slot, 2] = lane_sum(s0), lane_sum(sx), lane_sum(sy)
                partial[slot, 3], partial[slot, 4], partial[slot, 5] = lane_sum(sxx), lane_sum(sxy), lane_sum(syy)
