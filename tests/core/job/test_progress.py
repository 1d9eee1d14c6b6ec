# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.errors import Cancelled
from gskin_addon.core.job.progress import CancelFlag, Progress, RemainingTime


def test_steady_work_is_foreseen():
    remaining = RemainingTime()
    for now in np.arange(0.0, 60.0, 0.5):
        left = remaining.update(now, now / 100)
    assert left == pytest.approx(100 - 59.5, rel=0.02)


def test_a_slower_stage_is_noticed():
    # 10 s for the first half, then 100 s for the second: 20 s into it, 80 s are left, not 12.
    remaining = RemainingTime()
    for now in np.arange(0.0, 30.0, 0.25):
        left = remaining.update(now, min(now / 20, 0.5 + (now - 10) / 200))
    assert left == pytest.approx(80, rel=0.15)


def test_a_resumed_job_is_not_taken_for_a_fast_one():
    remaining = RemainingTime()
    for now in np.arange(0.0, 10.0, 0.25):
        left = remaining.update(now, 0.9 + now / 1000)
    assert left == pytest.approx(90, rel=0.05)


def test_nothing_is_said_without_a_measure():
    remaining = RemainingTime()
    assert remaining.update(0.0, 0.0) is None
    assert remaining.update(0.5, 0.5) is None  # half a second proves nothing
    assert RemainingTime().update(9.0, 1.0) is None


def test_lines_are_thinned_and_never_fall():
    now, lines = [0.0], []
    progress = Progress(lines.append, CancelFlag(), clock=lambda: now[0])
    for step in range(1000):
        now[0] += 0.01
        progress("learn" if step < 500 else "write", np.sin(step / 300), {"l1": 1.0}, "")
    assert 90 <= len(lines) <= 102
    assert [line["stage"] for line in lines].count("write") >= 45
    fractions = [line["fraction"] for line in lines]
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] <= fractions[-1] <= 1


def test_cancelling_raises():
    cancelled = CancelFlag()
    progress = Progress(lambda line: None, cancelled)
    progress("learn", 0.1)
    cancelled.set()
    with pytest.raises(Cancelled):
        progress("learn", 0.2)
