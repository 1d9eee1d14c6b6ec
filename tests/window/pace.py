# SPDX-License-Identifier: GPL-3.0-or-later
"""How much longer things take at the moment than on a machine that has nothing else to do.

A process of its own does the same piece of work again and again (`python pace.py FILE`) and notes how long each took by
the clock, and in the processor's time. The ratio is the pace: 1 on a quiet machine, 3 where others take two thirds.
Times of a window are judged by their bar times the pace, so that they can be judged on any machine on any day.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

STEPS = 1_000_000
"""Additions in a piece of work: about 50 ms, the order of what a window may be late by."""
PAUSE = 0.25


class Pace:
    """The meter's process and what it has noted so far; clock: that of `time.monotonic`."""

    def __init__(self, record: Path) -> None:
        self.record = record
        record.write_text("")
        self._meter = subprocess.Popen([sys.executable, __file__, str(record)], stdin=subprocess.PIPE)

    def stop(self) -> None:
        """End the meter."""
        self._meter.kill()
        self._meter.wait()

    def mean(self, since: float, until: float | None = None) -> float:
        """The mean pace between two times, at least 1; of the last pieces of work where none lies between."""
        paces = self._between(since, until)
        return max(1.0, sum(paces) / len(paces)) if paces else 1.0

    def busy(self, since: float, until: float | None = None) -> float:
        """The most processor time that a piece of work took, over its least, at least 1: shared caches and clocks."""
        return max([1.0, *self._between(since, until, 2)])

    def worst(self, since: float, until: float | None = None) -> float:
        """The slowest single piece of work between two times, at least 1."""
        return max([1.0, *self._between(since, until)])

    def _between(self, since: float, until: float | None, column: int = 1) -> list[float]:
        lines = self.record.read_text().splitlines()
        # The last line may be half written.
        pieces = [tuple(map(float, line.split()[:3])) for line in lines if line.endswith(" .")]
        if not pieces:
            return []
        # What the work costs when nobody interrupts: the least of all, because others only ever add.
        quiet = min(busy for _, _, busy in pieces)
        inside = [piece for piece in pieces if since <= piece[0] - piece[1] and (until is None or piece[0] <= until)]
        return [piece[column] / quiet for piece in inside or pieces[-3:]]


def meter(record: Path) -> None:
    """Work and note "end seconds busy" in lines that end in a full stop, until whoever started this is gone."""
    parent = os.getppid()
    with record.open("a", buffering=1) as lines:
        while os.getppid() == parent:
            began, busy = time.monotonic(), time.process_time()
            total = 0
            for step in range(STEPS):
                total += step
            end = time.monotonic()
            lines.write(f"{end:.6f} {end - began:.6f} {time.process_time() - busy:.6f} .\n")
            time.sleep(PAUSE)


if __name__ == "__main__":
    meter(Path(sys.argv[1]))
