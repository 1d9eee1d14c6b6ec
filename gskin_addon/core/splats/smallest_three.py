# SPDX-License-Identifier: GPL-3.0-or-later
"""Unit quaternions by their three smallest components and the place of the largest, as compressed formats keep them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cloud import Floats

Values = NDArray[np.float64]
Places = NDArray[np.int64]

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def drop_largest(quats: Floats) -> tuple[Places, Values]:
    """The place (M,) of each unit quaternion's largest component and the three others (M, 3), within +-sqrt(1/2).

    The sign is chosen so that the largest is positive: q and -q are one rotation.
    """
    place: Places = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    sign = np.where(quats[rows, place] < 0.0, -1.0, 1.0)
    return place, quats.astype(np.float64)[rows[:, None], _OTHERS[place]] * sign[:, None]


def restore_largest(place: NDArray[Any], others: Values) -> Values:
    """Unit quaternions (M, 4) from the places 0..3 and the three other components (M, 3)."""
    quats = np.empty((len(others), 4))
    rows = np.arange(len(others))
    quats[rows[:, None], _OTHERS[place]] = others
    quats[rows, place] = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("ni,ni->n", others, others)))
    unit: Values = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return unit
