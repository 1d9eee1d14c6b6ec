# SPDX-License-Identifier: GPL-3.0-or-later
"""Skinning weights from a proxy mesh's vertices to the splats anchored to it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .anchoring import Anchors

Array = NDArray[Any]


def splat_weights(anchors: Anchors, vertex_weights: Array, faces: Array) -> Array:
    """Weights (N, B) of the splats: those of their triangle's vertices (V, B), blended by the barycentrics."""
    weights = np.asarray(vertex_weights)
    triangles = np.asarray(faces)[anchors.face]
    out = np.zeros((anchors.count, weights.shape[1]), dtype=weights.dtype)
    for k in range(3):
        out += anchors.bary[:, k : k + 1].astype(weights.dtype) * weights[triangles[:, k]]
    return out
