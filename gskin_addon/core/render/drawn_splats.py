# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats as a display draws them: posed, in their object's own space, with the turn that their bones gave them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..splats.cloud import SplatCloud

Array = NDArray[np.float32]


@dataclass(frozen=True)
class DrawnSplats:
    """N posed splats of one object. All arrays are float32 and are never written to: threads share them.

    points (N, 3), rotations (N, 4) wxyz of any length, scales (N, 3) standard deviations, opacities (N,) 0 to 1,
    sh (N, K, 3) as at rest, turns (N, 4) wxyz: how the bones turned each splat since rest, None where none has moved;
    colors (N, 3) sRGB in place of the harmonics' where a display shows something else, as weights;
    matrix (4, 4): the object's space to the world's.
    """

    points: Array
    rotations: Array
    scales: Array
    opacities: Array
    sh: Array
    turns: Array | None = None
    colors: Array | None = None
    matrix: NDArray[np.float64] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.matrix is None:
            object.__setattr__(self, "matrix", np.eye(4))

    @property
    def count(self) -> int:
        """The number of splats."""
        return len(self.points)

    def select(self, index: NDArray[Any]) -> DrawnSplats:
        """The splats of an index (M,) or mask (N,)."""
        picked = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "matrix"}
        picked = {name: values if values is None else values[index] for name, values in picked.items()}
        return DrawnSplats(**picked, matrix=self.matrix)


def drawn_cloud(cloud: SplatCloud, matrix: ArrayLike | None = None) -> DrawnSplats:
    """A cloud as it is, its harmonics in its own axes; matrix (4, 4) takes it to the world."""
    return DrawnSplats(
        cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh,
        matrix=np.eye(4) if matrix is None else np.asarray(matrix, np.float64),
    )  # fmt: skip


def largest(scales: NDArray[Any], opacities: NDArray[Any], limit: int) -> NDArray[np.int64] | None:
    """Index (limit,), rising, of the splats that hide most: opacity times the area of the two longer axes.

    scales (N, 3), opacities (N,). None where no more than `limit` are there.
    """
    if len(scales) <= limit:
        return None
    first, second, third = scales.T
    area = np.maximum(np.maximum(first * second, second * third), first * third)
    taken = np.argpartition(-(area * opacities), max(limit - 1, 0))[:limit]
    taken.sort()
    return taken
