# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress as the pipeline tells it, as the lines of the contract. Standard library only."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..errors import Cancelled


@dataclass(frozen=True)
class ProgressEvent:
    """One line of the worker: fraction 0 to 1 of the whole job, seconds_left or None, losses by name."""

    stage: str
    fraction: float = 0.0
    seconds_left: float | None = None
    losses: dict[str, float] = field(default_factory=dict)
    message: str = ""


class CancelFlag:
    """Set once when the job is to stop, seen by all threads.

    Unlike threading.Event it holds no lock, so a signal handler may set it even where it interrupts its own thread in
    the middle of `set`.
    """

    def __init__(self) -> None:
        self._up = False

    def set(self) -> None:
        """From now on `is_set`."""
        self._up = True

    def is_set(self) -> bool:
        """Whether anyone has set it."""
        return self._up


class Progress:
    """What the pipeline calls; sends lines no faster than a person can read.

    Calling it raises Cancelled once `cancelled` is set, so that the pipeline unwinds at a safe place.
    """

    INTERVAL = 0.1

    def __init__(
        self,
        send: Callable[[dict[str, Any]], None],
        cancelled: CancelFlag,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._send, self._cancelled, self._clock = send, cancelled, clock
        self._fraction = 0.0
        self._last: tuple[str, float] | None = None
        self._started = clock()

    def __call__(
        self,
        stage: str,
        fraction: float,
        losses: Mapping[str, float] | None = None,
        message: str = "",
        seconds_left: float | None = None,
    ) -> None:
        """`fraction` (0 to 1) of the whole job, never falling; `losses` by name; `message` for a person.

        `seconds_left` where the caller knows; see `core/pipeline/eta.py`.
        """
        if self._cancelled.is_set():
            raise Cancelled("The job was cancelled.")
        now = self._clock()
        if math.isfinite(fraction):
            self._fraction = max(self._fraction, min(1.0, float(fraction)))
        if seconds_left is not None and not math.isfinite(seconds_left):
            seconds_left = None
        if self._last is not None and self._last[0] == stage and now - self._last[1] < self.INTERVAL:
            return
        self._last = (stage, now)
        finite = {name: float(value) for name, value in (losses or {}).items() if math.isfinite(value)}
        self._send(
            {
                "stage": stage,
                "fraction": round(self._fraction, 5),
                "seconds_left": None if seconds_left is None else round(seconds_left, 1),
                "elapsed": round(now - self._started, 2),
                "losses": finite,
                "message": message,
            }
        )
