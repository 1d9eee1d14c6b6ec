# SPDX-License-Identifier: GPL-3.0-or-later
"""A run on its way: what is done, what it cost, and how long the rest takes, told to a progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from .forecast import Forecast

Tell = Callable[..., None]
"""progress(stage, fraction, losses, message, seconds left); see `Progress`."""


class Course:
    """Times pieces of work one after the other. Standard library only."""

    def __init__(
        self, tell: Tell, kinds: Mapping[str, tuple[int, float]], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """tell: where news go; kinds: see `Forecast`."""
        self.forecast = Forecast(kinds)
        self.seconds: dict[str, float] = {}
        self._tell, self._clock = tell, clock
        self._mark = self._stage_mark = clock()

    def say(self, stage: str, message: str, losses: Mapping[str, float] | None = None) -> None:
        """Tell how far the run is. May raise Cancelled; the time that telling takes counts for nothing."""
        before = self._clock()
        self._tell(stage, self.forecast.fraction(), losses or {}, message, self.forecast.left())
        self._mark += self._clock() - before

    def did(self, kind: str, pieces: int = 1) -> None:
        """`pieces` of a kind are done, in the time since the last piece of any kind."""
        self.forecast.did(kind, self._lap(), pieces)

    def tried(self, kind: str, pieces: float = 1) -> None:
        """As `did`, but the work was only to measure and has still to be done."""
        self.forecast.tried(kind, self._lap(), pieces)

    def rest(self) -> None:
        """Forget the time since the last piece: it went into something that does not come again."""
        self._lap()

    def end_stage(self, name: str) -> None:
        """The wall seconds of a stage of the run go into `seconds`, for the report."""
        now = self._clock()
        self.seconds[name] = round(now - self._stage_mark, 2)
        self._stage_mark = now

    def _lap(self) -> float:
        now = self._clock()
        seconds, self._mark = now - self._mark, now
        return seconds
