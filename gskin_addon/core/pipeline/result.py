# SPDX-License-Identifier: GPL-3.0-or-later
"""The result of a recipe."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.influences import Influences


@dataclass(frozen=True, eq=False)
class SkinResult:
    """weights (N, B) float32, rows sum to 1; report: numbers and words; previews: images (H, W, 3) in [0, 1] by name;
    mesh_weights (V, B): of the proxy mesh's vertices, where the job has one; confidence (N,) in 0..1, if the method
    gives one; start: the splats' weights before learning, to compare with, where something was learned."""

    weights: NDArray[np.float32]
    report: dict[str, Any]
    previews: dict[str, NDArray[Any]] = field(default_factory=dict)
    mesh_weights: NDArray[np.float32] | None = None
    confidence: NDArray[np.float32] | None = None
    start: Influences | None = None
