# SPDX-License-Identifier: GPL-3.0-or-later
"""How much of a run is done and how long the rest takes, from what each kind of work was seen to cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median


@dataclass
class Work:
    """Equal pieces of one kind of work. guess: seconds for each before any was measured."""

    pieces: int
    guess: float
    done: int = 0
    seen: float = 0.0
    measured: float = 0.0
    """Pieces that were timed: those done in this process, or tried out."""

    def cost(self, speed: float) -> float:
        """Seconds for each piece; `speed` corrects guesses."""
        return self.seen / self.measured if self.measured else self.guess * speed


class Forecast:
    """Seconds of a run by kinds of work, in the order in which they come.

    Image sizes, guidance and the rest cost very differently, so the time left is no matter of a single rate: each
    kind has its own cost for a piece, measured where it was met or tried out (`tried`), and guessed elsewhere. The
    guesses are corrected by how the measured kinds compare with their guesses.
    """

    def __init__(self, kinds: Mapping[str, tuple[int, float]]) -> None:
        """kinds: name -> (pieces, guessed seconds for each)."""
        self._work = {name: Work(pieces, guess) for name, (pieces, guess) in kinds.items()}

    def tried(self, kind: str, seconds: float, pieces: float = 1) -> None:
        """A measure of `pieces` pieces that do not count as done."""
        work = self._work[kind]
        work.seen += seconds
        work.measured += pieces

    def did(self, kind: str, seconds: float, pieces: int = 1) -> None:
        """`pieces` more are done and took `seconds`."""
        self.tried(kind, seconds, pieces)
        self.skip(kind, pieces)

    def skip(self, kind: str, pieces: int) -> None:
        """`pieces` more are done without having been timed (before the process began, say)."""
        work = self._work[kind]
        work.done = min(work.done + pieces, work.pieces)

    def left(self) -> float:
        """Seconds to the end."""
        speed = self._speed()
        return sum((work.pieces - work.done) * work.cost(speed) for work in self._work.values())

    def fraction(self) -> float:
        """Part of the whole run's seconds that is done, 0 to 1."""
        speed = self._speed()
        whole = sum(work.pieces * work.cost(speed) for work in self._work.values())
        return 1.0 - self.left() / whole if whole > 0 else 0.0

    def _speed(self) -> float:
        """Measured over guessed seconds: the median of the kinds, as some guidance is a thousand times slower.

        Kinds that were only tried out count where there are no others: iterations vary in ways of their own.
        """
        known = [work for work in self._work.values() if work.measured and work.guess]
        known = [work for work in known if work.done] or known
        ratios = [work.seen / work.measured / work.guess for work in known]
        return median(ratios) if ratios else 1.0
