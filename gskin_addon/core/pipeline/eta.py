# SPDX-License-Identifier: GPL-3.0-or-later
"""How much of a run is done and how long the rest takes, from the measured cost of each kind of work.

The one place that knows the time left: jobs, the training commands and the window all show what it says.
Standard library only.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median

Report = Callable[..., None]
"""progress(stage, fraction, losses, message, seconds left); see `core/job/progress.py: Progress`."""

MEMORY = 4.0
"""Seconds (or a ninth of what a kind has taken so far, or ten pieces, where these are longer) after which a measure
counts for a third: a machine that gets busy shows in the time left."""
STEADY = 10
"""Pieces of a kind that must be done before it shows how the machine's pace has changed."""
TRIAL_NOISE = 1.35
"""Three trials alone are off by up to this factor, so only a larger change of pace counts."""
DRIFT = (0.5, 2.0)
"""Bounds of the change of pace that one kind may imply for the others."""


@dataclass
class WorkKind:
    """Equal pieces of one kind of work. guess: seconds for each before any was measured."""

    pieces: int
    guess: float
    done: float = 0.0
    seconds: float = 0.0
    """Of the pieces that were timed, the older ones counted less."""
    measured: float = 0.0
    """Pieces that were timed, likewise."""
    total: float = 0.0
    """Seconds of all pieces that were timed."""
    trial_cost: float = 0.0
    """Seconds for each piece in the trials before any was done; 0 where there were none."""

    def measure(self, seconds: float, pieces: float) -> None:
        """`pieces` pieces took `seconds`."""
        self.total += seconds
        keep = math.exp(-seconds / max(MEMORY, self.total / 9, 10 * seconds))
        self.seconds = self.seconds * keep + seconds
        self.measured = self.measured * keep + pieces

    @property
    def cost(self) -> float:
        """Measured seconds for each piece; 0 where nothing was measured."""
        return self.seconds / self.measured if self.measured else 0.0


class Eta:
    """Times pieces of work one after the other and says how long the rest takes.

    Image sizes, guidance and the other work cost very differently, so the time left does not follow from a single
    rate: each kind has its own cost per piece, measured if it was done or tried out (`record_trial`), and estimated
    otherwise. Estimates are corrected by how the measured kinds compare with their own, trials by how much slower or
    faster the kinds in progress have become since they were tried.
    """

    def __init__(
        self,
        report: Report,
        kinds: Mapping[str, tuple[int, float]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """report: called with the progress; kinds: name -> (pieces, guessed seconds for each), in
        the order of the run."""
        self.stage_seconds: dict[str, float] = {}
        self._kinds = {name: WorkKind(pieces, guess) for name, (pieces, guess) in kinds.items()}
        self._report, self._clock = report, clock
        self._mark = self._stage_mark = clock()

    def report(self, stage: str, message: str, losses: Mapping[str, float] | None = None) -> None:
        """Report the progress of the run. May raise Cancelled; the time that the report takes is not counted."""
        before = self._clock()
        self._report(stage, self.fraction(), losses or {}, message, self.seconds_left())
        self._mark += self._clock() - before

    def record(self, kind: str, pieces: float = 1) -> None:
        """`pieces` of a kind were done in the time since the last piece of any kind."""
        self._kinds[kind].measure(self._lap(), pieces)
        self.skip(kind, pieces)

    def record_up_to(self, kind: str, fraction: float) -> None:
        """A kind is done up to `fraction` (0 to 1) of its pieces; the new ones took the time since the last piece."""
        work = self._kinds[kind]
        ahead = min(fraction, 1.0) * work.pieces - work.done
        if ahead > 0:
            self.record(kind, ahead)

    def record_trial(self, kind: str, pieces: float = 1) -> None:
        """As `record`, but the work was only to measure and has still to be done."""
        work = self._kinds[kind]
        work.measure(self._lap(), pieces)
        work.trial_cost = work.cost

    def skip(self, kind: str, pieces: float) -> None:
        """`pieces` more are done without having been timed (before the process began, say)."""
        work = self._kinds[kind]
        work.done = min(work.done + pieces, work.pieces)

    def skip_rest(self, kind: str) -> None:
        """What is left of a kind need not be done; of one that the run does not have, nothing is."""
        if kind in self._kinds:
            self.skip(kind, self._kinds[kind].pieces)

    def forget(self) -> None:
        """Ignore the time since the last piece: it was spent on something that does not recur."""
        self._lap()

    def end_stage(self, name: str) -> None:
        """Add the wall seconds of a stage of the run to `stage_seconds`, for the report."""
        now = self._clock()
        self.stage_seconds[name] = round(now - self._stage_mark, 2)
        self._stage_mark = now

    def seconds_left(self) -> float:
        """Seconds to the end."""
        costs = self._costs()
        return sum((work.pieces - work.done) * costs[name] for name, work in self._kinds.items())

    def fraction(self) -> float:
        """Part of the whole run's seconds that is done, 0 to 1."""
        costs = self._costs()
        whole = sum(work.pieces * costs[name] for name, work in self._kinds.items())
        left = sum((work.pieces - work.done) * costs[name] for name, work in self._kinds.items())
        return 1.0 - left / whole if whole > 0 else 0.0

    def _costs(self) -> dict[str, float]:
        """Seconds for a piece of each kind."""
        speed, drift = self._speed(), self._drift()
        costs = {}
        for name, work in self._kinds.items():
            tried_only = work.measured and not work.done
            costs[name] = work.cost * (drift if tried_only else 1.0) if work.measured else work.guess * speed
        return costs

    def _speed(self) -> float:
        """Measured over guessed seconds: the median of the kinds, as some guidance is a thousand times slower.

        Kinds that were only tried out count if there are no others: iterations vary in ways of their own.
        """
        known = [work for work in self._kinds.values() if work.measured and work.guess]
        known = [work for work in known if work.done] or known
        ratios = [work.cost / work.guess for work in known]
        return median(ratios) if ratios else 1.0

    def _drift(self) -> float:
        """Current over trial seconds of the kinds that were both tried and done: how the machine's pace has changed."""
        known = [work for work in self._kinds.values() if work.trial_cost and work.done >= STEADY]
        ratios = [work.cost / work.trial_cost for work in known]
        drift = median(ratios) if ratios else 1.0
        if 1 / TRIAL_NOISE < drift < TRIAL_NOISE:
            return 1.0
        return min(max(drift, DRIFT[0]), DRIFT[1])

    def _lap(self) -> float:
        now = self._clock()
        seconds, self._mark = now - self._mark, now
        return seconds


class StageEta:
    """Time left of work that says only which fraction of itself is done, such as the training commands."""

    WARM_UP = 1.5
    """Seconds before an estimate is given: less is too noisy."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._eta: Eta | None = None
        self._begun = 0.0
        self._first = 0.0

    def seconds_left(self, fraction: float) -> float | None:
        """Record that `fraction` (0 to 1) is done; returns the seconds left, or None while nothing is measured.

        The first fraction is where a resumed run begins; it does not count towards this run's speed.
        """
        now = self._clock()
        if self._eta is None:
            self._eta = Eta(_no_report, {"work": (1, 0.0)}, self._clock)
            self._eta.skip("work", fraction)
            self._begun, self._first = now, fraction
            return None
        self._eta.record_up_to("work", fraction)
        if now - self._begun < self.WARM_UP or fraction - self._first < 1e-3:
            return None
        left = self._eta.seconds_left()
        return left if math.isfinite(left) else None


def _no_report(*_: object) -> None:
    return None
