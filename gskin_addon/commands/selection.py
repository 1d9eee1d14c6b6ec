# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that name some splats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files import read_arrays

Array = NDArray[Any]


def read_selection(path: Path, count: int) -> Array:
    """Indices (K,) int64 of splats from a file: an .npz with the array `selected`, or a text of numbers.

    `selected` has indices, or is a mask of all `count` splats, of bools or of zeros and ones; a text may be such a
    mask, too.

    Raises InputError: no such file, damaged, no splats, others than 0 to `count` - 1, a mask of another length.
    """
    try:
        if path.suffix.lower() == ".npz":
            chosen = read_arrays(path, ("selected",), ())["selected"]
        else:
            chosen = np.array([int(word) for word in path.read_text("utf-8").replace(",", " ").split()])
    except FileNotFoundError:
        raise InputError(f"'{path}' does not exist; check the path of the selection.") from None
    except (OSError, ValueError) as error:
        raise InputError(
            f"'{path}' is no selection ({error}); give an .npz with the array 'selected' or a text of splat numbers."
        ) from None
    if _is_mask(chosen):
        if chosen.shape != (count,):
            raise InputError(
                f"'{path}' is a mask of {chosen.size:,} splats, and there are {count:,}; make it from the same splats."
            )
        chosen = np.flatnonzero(chosen)
    if chosen.ndim != 1 or not len(chosen) or chosen.dtype.kind not in "iu":
        raise InputError(f"'{path}' names no splats; give their numbers, from 0 to {count - 1}.")
    if chosen.min() < 0 or chosen.max() >= count:
        raise InputError(f"'{path}' names splats outside 0 to {count - 1}; make the selection from the same splats.")
    return chosen.astype(np.int64)


def _is_mask(chosen: Array) -> bool:
    """Whether the numbers say yes or no of splat after splat: as splats 0 and 1 they would come again and again."""
    if chosen.dtype == np.bool_:
        return True
    return chosen.ndim == 1 and chosen.dtype.kind in "iu" and len(chosen) > 2 and bool(np.isin(chosen, (0, 1)).all())


def read_walls(paths: Sequence[Path], count: int) -> Array:
    """Labels (count,) int64 of splats as `core.skinning.walls` has them, from files of marked splats.

    One file: its splats are one side, all others the other. Several: each is a side of its own, and splats in none have
    no label. An .npz may hold labels of all splats itself, as `walls`.

    Raises InputError as `read_selection` does; splats that two files mark.
    """
    labels = np.zeros(count, np.int64)
    for number, path in enumerate(paths, 1):
        given = _labels(path, count)
        if given is not None:
            if len(paths) > 1:
                raise InputError(f"'{path}' holds the labels of all walls; give it as the only --walls.")
            return given
        rows = read_selection(path, count)
        if labels[rows].any():
            other = paths[int(labels[rows].max()) - 1]
            raise InputError(f"'{path}' and '{other}' mark the same splats; a splat is on one side of a wall.")
        labels[rows] = number
    if len(paths) == 1:
        labels[labels == 0] = 2
    return labels


def _labels(path: Path, count: int) -> Array | None:
    """The labels (count,) in an .npz; None where it has none. What else it lacks `read_selection` says."""
    if path.suffix.lower() != ".npz" or not path.is_file():
        return None
    try:
        labels = read_arrays(path, (), ("walls",)).get("walls")
    except (OSError, ValueError):
        return None
    if labels is None:
        return None
    if labels.shape != (count,) or labels.dtype.kind not in "iu":
        raise InputError(f"'{path}' has walls {labels.shape} of {labels.dtype} for {count:,} splats; mark them again.")
    return labels.astype(np.int64)
