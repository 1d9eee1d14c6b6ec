# SPDX-License-Identifier: GPL-3.0-or-later
"""What all weight fields have in common."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...ticks import Tick, silent
from . import LOG_FLOOR


class WeightField(torch.nn.Module):
    """weights = softmax(prior + learned logits), at the N splats that it was made for; the prior is the log of the
    initial weights.

    rate: Adam's learning rate as a factor of the preset's, which is meant for parameters that are logits.
    """

    rate: float = 1.0

    def __init__(self, initial: NDArray[Any]) -> None:
        """initial (N, B) weights with rows that sum to 1."""
        super().__init__()
        floor = np.maximum(np.asarray(initial, np.float64), LOG_FLOOR)
        prior = np.log(floor / floor.sum(1, keepdims=True)).astype(np.float32)
        self.register_buffer("_initial", torch.from_numpy(prior), persistent=False)
        self._initial: torch.Tensor
        # What the learned logits are added to; a field that needs no prior puts a zero there.
        self.register_buffer("_prior", self._initial, persistent=False)
        self._prior: torch.Tensor

    def initial(self) -> torch.Tensor:
        """The initial weights (N, B) of the field: at least about `LOG_FLOOR`."""
        return self._initial.exp()

    def fit(self, tick: Tick = silent) -> dict[str, float]:
        """Bring the weights to the initial ones before anything is learned, where they do not start there anyway.

        Returns numbers for the report: "steps" and the root mean square "error" of a weight; nothing where nothing had
        to be done. `tick` takes the part that is done.
        """
        return {}

    def query(self, points: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.bool_]] | None:
        """Learned logits (M, B) at other points (M, 3), and where they are known (M,); None if the field is no function
        of space or cannot be evaluated elsewhere."""
        return None

    @abstractmethod
    def residual(self) -> torch.Tensor:
        """Learned logits (N, B); zeros (or constant rows) leave the initial weights as they are."""

    def forward(self) -> torch.Tensor:
        """Weights (N, B) of the splats, rows sum to 1."""
        return torch.softmax(self._prior + self.residual(), dim=1)
