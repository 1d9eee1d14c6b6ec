# SPDX-License-Identifier: GPL-3.0-or-later
"""Early stopping: when the loss on held-out poses stops falling."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

ENOUGH = 0.005
"""Relative decrease of the loss that counts as progress."""


@dataclass
class EarlyStop:
    """Follows the held-out loss. patience: checks in a row without progress that end the run, 0 for never.

    reason: why to stop, empty to continue; best, best_at: the lowest loss and its iteration.
    """

    patience: int
    history: list[tuple[int, float]] = field(default_factory=list)
    best: float = float("inf")
    best_at: int = -1
    reason: str = ""
    _mark: float = float("inf")
    _waited: int = 0

    def add(self, iteration: int, loss: float, *, counts: bool = True) -> bool:
        """Record the loss after so many iterations; True if it is the lowest so far. `counts=False` is for stages
        before the last, in which a lack of progress does not end the run.
        """
        self.history.append((iteration, loss))
        better = loss < self.best
        if better:
            self.best, self.best_at = loss, iteration
        if not counts or loss < self._mark * (1 - ENOUGH):
            self._mark, self._waited = min(loss, self._mark), 0
        else:
            self._waited += 1
        if self.patience and self._waited >= self.patience:
            self.reason = (
                f"held-out poses did not improve by {ENOUGH:.1%} in the last {self._waited} checks"
                f" (iteration {iteration})"
            )
        return better

    def state(self) -> dict[str, Any]:
        """Plain values for `restore`."""
        return dict(vars(self), history=list(self.history))

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`."""
        vars(self).update(state, history=list(state["history"]))
