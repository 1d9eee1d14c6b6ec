# SPDX-License-Identifier: GPL-3.0-or-later
"""Work in threads: results in order, ticks from one thread, errors and stops end all of it."""

from __future__ import annotations

import threading
import time

import pytest

from gskin_addon.core.errors import Cancelled
from gskin_addon.core.ticks import stretch, work


def test_results_come_in_order_and_ticks_rise():
    told, threads = [], set()

    def task(number, tick):
        for part in range(5):
            time.sleep(0.03)
            tick((part + 1) / 5)
        return number

    def listen(done):
        told.append(done)
        threads.add(threading.get_ident())

    tasks = [lambda tick, n=n: task(n, tick) for n in range(4)]
    assert work(tasks, stretch(listen, 0.2, 0.6), 2) == [0, 1, 2, 3]
    assert told == sorted(told)
    assert told[-1] == pytest.approx(0.6)
    assert any(0.2 < done < 0.6 for done in told)
    assert threads == {threading.get_ident()}
    assert work([], listen, 2) == []


@pytest.mark.parametrize("who", ["tick", "task"])
def test_an_error_stops_all_tasks(who):
    begun = time.monotonic()
    turns = [0, 0]

    def task(number, tick):
        for _ in range(2000):
            time.sleep(0.01)
            turns[number] += 1
            tick(0.1)
            if who == "task" and number == 0 and turns[0] == 5:
                raise ValueError("a fault")

    def listen(done):
        if who == "tick" and done > 0:
            raise Cancelled

    with pytest.raises(Cancelled if who == "tick" else ValueError):
        work([lambda tick, n=n: task(n, tick) for n in range(2)], listen, 2)
    assert time.monotonic() - begun < 5
    after = list(turns)
    time.sleep(0.1)
    assert turns == after  # nobody goes on
    assert max(turns) < 2000
