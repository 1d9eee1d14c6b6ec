# SPDX-License-Identifier: GPL-3.0-or-later
"""Per-splat refinement: logits of each splat on top of a field, learned in the last part of a run."""

from __future__ import annotations

import torch

from .base import WeightField


class RefinedField(WeightField):
    """residual = field's residual + own logits (N, B), which begin to learn when `begin` (0 to 1) of a run is done.

    A field is smooth in space; splats that touch across a gap, or lie where weights change abruptly, need more.
    """

    def __init__(self, field: WeightField, begin: float) -> None:
        """field: the one to refine; it goes on learning."""
        super().__init__(field.initial().numpy())
        self.rate, self._begin = field.rate, begin
        self.inner = field
        self.own = torch.nn.Parameter(torch.zeros_like(self._prior), requires_grad=False)

    def unlock(self, part: float) -> None:
        """See WeightField."""
        self.inner.unlock(part)
        self.own.requires_grad_(part >= self._begin)

    def residual(self) -> torch.Tensor:
        """Logits (N, B) of the field and of the splats."""
        logits = self.inner.residual()
        return logits + self.own if self.own.requires_grad or bool(self.own.any()) else logits
