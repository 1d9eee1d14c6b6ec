# SPDX-License-Identifier: GPL-3.0-or-later
"""What trainings on image pairs share, whatever model they are of: the loop, how far it is, and what it leaves."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from ...errors import InputError
from ...guidance.lightning_drag.files import FINE_TUNED, read_table
from .pairs import PairDataset
from .tune_state import check_identity

Report = Callable[[float, str], None]
HISTORY = 100
"""Losses kept, each the mean since the one before."""


class TrainingLoop:
    """One training: what it is of, and how far it is. A model's own has `_updates`, `_validate`, `_save`, `_write`."""

    _parameters: Mapping[str, torch.nn.Parameter]

    def __init__(
        self,
        options: Any,
        data: PairDataset,
        held_out: PairDataset | None,
        identity: Mapping[str, Any],
        out: Path,
        size: int,
    ) -> None:
        """options: with `epochs`, `updates`, `save_minutes`, `validation`; size: pairs of an update."""
        self._options, self._data, self._held_out, self._size = options, data, held_out, size
        self._identity, self._out = identity, out
        self.total = options.updates or math.ceil(options.epochs * len(data) / size)
        self._update, self._scores = 0, dict[str, Any]()
        self._losses, self._since = list[dict[str, float]](), list[float]()

    def is_finished(self) -> bool:
        """Whether `out` already holds the end of this training, or of a longer one.

        Raises:
            InputError: it holds another training.
        """
        if not (self._out / FINE_TUNED).is_file():
            return False
        facts = read_table(self._out / FINE_TUNED)
        check_identity(self._out, facts.get("identity", {}), self._identity)
        return int(facts.get("updates", 0)) >= self.total

    def run(self, report: Report) -> None:
        """Train to the end, validate, and write the weights."""
        self._validate("before", report)
        saved = time.monotonic()
        for loss in self._updates():
            self._update += 1
            self._since.append(loss)
            if self._update % max(1, self.total // HISTORY) == 0:
                mean = sum(self._since) / len(self._since)
                self._losses.append({"update": self._update, "loss": round(mean, 6)})
                self._since = []
            report(0.98 * self._update / self.total, f"Update {self._update} of {self.total}, loss {loss:.4f}")
            self._after_update(report)
            if time.monotonic() - saved >= 60 * self._options.save_minutes:
                self._save()
                saved = time.monotonic()
        self._save()
        self._validate("after", report)
        self._write()

    def _updates(self) -> Iterator[float]:
        """The mean loss of each update, as it is done."""
        raise NotImplementedError

    def _after_update(self, report: Report) -> None:
        """What else is done between updates."""

    def _validate(self, when: str, report: Report) -> None:
        """Put the validation's scores into `_scores`, where there are pairs for it, unless it `_is_validated`."""
        raise NotImplementedError

    def _save(self) -> None:
        """Write a checkpoint to continue from."""
        raise NotImplementedError

    def _write(self) -> None:
        """Write the trained weights, and `_facts`."""
        raise NotImplementedError

    def _is_validated(self, when: str) -> bool:
        """Whether this validation is done, or none is asked for."""
        return not self._options.validation or when in self._scores

    def _telling(self, when: str, report: Report) -> Callable[[float], None]:
        """What tells how much of a validation is done."""
        part = self._update / self.total

        def tell(done: float) -> None:
            report(0.98 * part + (0.02 * done if when == "after" else 0.0), f"Validation {when}: {done:.0%}")

        return tell

    def _state(self, adam: Any, average: Mapping[str, torch.Tensor], scaler: Any) -> dict[str, Any]:
        """What a checkpoint holds."""
        return {
            "identity": dict(self._identity),
            "update": self._update,
            "weights": {name: value.detach() for name, value in self._parameters.items()},
            "average": average,
            "adam": adam.state_dict(),
            "scaler": None if scaler is None else scaler.state_dict(),
            "scores": self._scores,
            "losses": self._losses,
            "since": self._since,
        }

    def _go_on_from(self, state: Mapping[str, Any]) -> None:
        """Be as far as a checkpoint was."""
        self._update, self._scores = state["update"], state["scores"]
        self._losses, self._since = state["losses"], state["since"]

    def _facts(self, **own: Any) -> dict[str, Any]:
        """What is told of the trained weights in `fine_tuned.json`."""
        return {
            "version": 1,
            **own,
            "updates": self._update,
            "epochs": round(self._update * self._size / len(self._data), 2),
            "pairs": len(self._data),
            "validation": self._scores,
            "losses": self._losses,
            "identity": dict(self._identity),
        }


def diverged() -> InputError:
    """The error of a training whose loss is NaN or infinite."""
    return InputError(
        "The training diverged (its loss is no longer a number); start again with a lower learning_rate, "
        "or dtype=float32."
    )
