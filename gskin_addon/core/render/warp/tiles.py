# SPDX-License-Identifier: GPL-3.0-or-later
"""Warp kernels that list the splats of every tile of every image from near to far."""

from __future__ import annotations

import warp as wp

from .project import TILE, Floats, Ints, Longs, Vec2ds, Vec3s, Vec4is, Vec4s

wp.set_module_options({"enable_backward": False})

RECORD = 10
"""mx, my (pixel, from the centre of the tile's first), rows reached, A, B, C, K, red, green, blue."""

record_t = wp.types.vector(length=RECORD, dtype=wp.float32)

Records = wp.array(dtype=record_t)

_TILE = wp.constant(TILE)


@wp.kernel
def list_pairs(
    splats: int, columns: int, rows: int, rect: Vec4is, tiles: Longs, last_slot: Longs, depth: Floats, keys: Longs,
    slots: Ints, owner: Ints,
) -> None:  # fmt: skip
    """Per (splat, tile) pair: its key (tile of the batch << 32 | depth bits), its slot, and the slot's splat.

    The bits of a positive float sort like the float; pairs are listed in the order of the splats, which the
    stable sort keeps where depths are equal.
    """
    e = wp.tid()
    if tiles[e] == wp.int64(0):
        return
    p = e // splats
    box = rect[e]
    slot = int(last_slot[e] - tiles[e])
    near = wp.int64(wp.cast(depth[e], wp.int32))
    for y in range(box[2], box[3]):
        for x in range(box[0], box[1]):
            tile = (p * rows + y) * columns + x
            keys[slot] = (wp.int64(tile) << wp.int64(32)) | near
            slots[slot] = slot
            owner[slot] = e
            slot += 1


@wp.kernel
def find_starts(pairs: int, keys: Longs, start: Ints) -> None:
    """start (tiles + 1,): the first of the sorted pairs that belongs to each tile or a later one."""
    tile = wp.tid()
    wanted = wp.int64(tile) << wp.int64(32)
    low = int(0)
    high = int(pairs)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    start[tile] = low


@wp.kernel
def gather(
    splats: int, columns: int, rows: int, keys: Longs, slots: Ints, owner: Ints, pixels: Vec2ds, conic: Vec4s,
    reach: Floats, colors: Vec3s, records: Records,
) -> None:  # fmt: skip
    """records (pairs,): what blending reads, in its order, so that a tile reads memory from one end to the other."""
    r = wp.tid()
    e = owner[slots[r]]
    i = e % splats
    tile = int(keys[r] >> wp.int64(32))
    x0 = tile % columns * _TILE
    y0 = tile // columns % rows * _TILE
    m = pixels[e]
    k = conic[e]
    c = colors[i]
    records[r] = record_t(
        wp.float32(m[0] - wp.float64(x0) - wp.float64(0.5)), wp.float32(m[1] - wp.float64(y0) - wp.float64(0.5)),
        reach[e], k[0], k[1], k[2], k[3], c[0], c[1], c[2],
    )  # fmt: skip
