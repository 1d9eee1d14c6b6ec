# SPDX-License-Identifier: GPL-3.0-or-later
"""The prior loss: it holds the weights near the initial ones where the images say nothing.

An image loss has no gradient for a splat that a wrong weight moves onto bare background, so a splat at a thin
tip, once lost to a bone that turns elsewhere, never comes back. The divergence KL(initial || weights) has the
gradient weights - initial on the logits: it never vanishes, and it is bounded, so good images win.

In jobs and checkpoints its key is "anchor".
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .fields.base import WeightField

NODES = 5000


class PriorLoss:
    """Mean over nodes of confidence x KL(initial || weights), on a random sample of the nodes each time."""

    def __init__(self, field: WeightField, confidence: NDArray[Any] | None = None) -> None:
        """confidence (M,), 0 to 1, of the field's nodes; 1 for all by default. Raises ValueError for another shape."""
        self._initial = field.initial()
        self._entropy = (self._initial * self._initial.log()).sum(1)
        count = len(self._initial)
        per_node = np.ones(count) if confidence is None else np.asarray(confidence)
        if per_node.shape != (count,):
            raise ValueError(f"confidence has shape {per_node.shape}, expected ({count},)")
        self._confidence = torch.as_tensor(per_node, dtype=torch.float32)

    def loss(self, weights: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        """The loss of weights (M, B)."""
        count = len(weights)
        if count > NODES:
            index = torch.from_numpy(rng.choice(count, NODES, replace=False))
            weights, initial = weights[index], self._initial[index]
            entropy, confidence = self._entropy[index], self._confidence[index]
        else:
            initial, entropy, confidence = self._initial, self._entropy, self._confidence
        divergence = entropy - (initial * weights.clamp_min(1e-12).log()).sum(1)
        return (confidence * divergence).mean()
