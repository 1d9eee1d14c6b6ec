# SPDX-License-Identifier: GPL-3.0-or-later
"""The anchor loss: weights stay near the initial ones where pictures say nothing.

An image loss has no gradient for a splat that a wrong weight holds over bare background, so a splat at a thin
tip, once lost to a bone that turns elsewhere, never comes back. The divergence KL(initial || weights) has the
gradient weights - initial on the logits: it never vanishes, and it is bounded, so good pictures win.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .fields.base import WeightField

NODES = 5000


class Anchor:
    """Mean over nodes of confidence x KL(initial || weights), on a random part of the nodes each time."""

    def __init__(self, field: WeightField, confidence: NDArray[Any] | None = None) -> None:
        """confidence (M,) in 0 to 1 of the field's nodes; 1 where left out."""
        self._initial = field.initial()
        self._entropy = (self._initial * self._initial.log()).sum(1)
        count = len(self._initial)
        trust = np.ones(count) if confidence is None else np.asarray(confidence)
        if trust.shape != (count,):
            raise ValueError(f"confidence has shape {trust.shape}, expected ({count},)")
        self._confidence = torch.as_tensor(trust, dtype=torch.float32)

    def loss(self, weights: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        """The loss of weights (M, B)."""
        count = len(weights)
        if count > NODES:
            index = torch.from_numpy(rng.choice(count, NODES, replace=False))
            weights, initial = weights[index], self._initial[index]
            entropy, trust = self._entropy[index], self._confidence[index]
        else:
            initial, entropy, trust = self._initial, self._entropy, self._confidence
        divergence = entropy - (initial * weights.clamp_min(1e-12).log()).sum(1)
        return (trust * divergence).mean()
