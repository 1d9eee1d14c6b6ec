# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.errors import Cancelled
from gskin_addon.core.job.progress import CancelFlag, Progress


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
