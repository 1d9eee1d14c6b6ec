# SPDX-License-Identifier: GPL-3.0-or-later
"""How many images a GPU renders at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby

from ..errors import InputError
from .camera import Camera

PIXELS_AT_ONCE = 8 * 512 * 512
"""Images are rendered together up to this many pixels: enough to fill a GPU, some 300 MB for the loss."""

PAIRS_AT_ONCE = 24_000_000
"""(splat, tile) pairs of one launch; each takes about 100 bytes."""


class TooManyPairs(Exception):
    """A batch that covers too many tiles for one launch."""


def in_batches(cameras: Sequence[Camera], step: Callable[[slice], None]) -> None:
    """step(part) for parts of the cameras, each of one image size and near plane; halved where it proves too large."""
    todo, first = [], 0
    for (size, _), group in groupby(cameras, lambda camera: (camera.size, camera.near)):
        last = first + len(list(group))
        most = max(1, PIXELS_AT_ONCE // (size[0] * size[1]))
        todo += [slice(lo, min(lo + most, last)) for lo in range(first, last, most)]
        first = last
    todo.reverse()
    while todo:
        part = todo.pop()
        try:
            step(part)
        except TooManyPairs:
            middle = (part.start + part.stop) // 2
            if middle == part.start:
                raise InputError(
                    "The splats cover too many tiles of one image for the GPU; take a smaller image size or remove "
                    "giant splats."
                ) from None
            todo += [slice(middle, part.stop), slice(part.start, middle)]
