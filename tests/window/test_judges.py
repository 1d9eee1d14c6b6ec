# SPDX-License-Identifier: GPL-3.0-or-later
"""What judges the window: looks at pictures, and the pace of the machine. Needs no Blender."""

from __future__ import annotations

import time

import numpy as np
import pytest

from tests.window.looks import changed, look
from tests.window.pace import Pace


def test_looks_tell_a_picture_from_an_empty_one():
    empty = np.full((90, 160, 3), 57, np.uint8)
    noisy = empty + np.random.default_rng(0).integers(0, 5, empty.shape, np.uint8)
    drawn = noisy.copy()
    drawn[20:65, 40:80] = np.random.default_rng(1).integers(80, 255, (45, 40, 3), np.uint8)
    assert look(empty).colours == 1
    assert look(noisy).filled == 0
    assert look(drawn).filled == pytest.approx(1 / 8, abs=1e-3)
    assert look(drawn).colours > 1000
    assert changed(noisy, empty) == 0
    assert changed(drawn, empty) == pytest.approx(1 / 8, abs=1e-3)


def test_pace_is_the_slowest_and_the_mean_work_of_a_time(tmp_path):
    pace = Pace(tmp_path / "pace.txt")
    pace.stop()
    now = time.monotonic()
    works = [(now + 1, 0.05, 0.05), (now + 2, 0.10, 0.06), (now + 3, 0.30, 0.06)]
    lines = [f"{end} {took} {busy} .\n" for end, took, busy in works]
    pace.record.write_text("".join(lines) + f"{now + 4} 9.0")
    assert pace.worst(now) == pytest.approx(6)
    assert pace.mean(now) == pytest.approx(3)
    assert pace.busy(now) == pytest.approx(1.2)
    assert pace.worst(now, now + 2.5) == pytest.approx(2)
    # Where no work ended in a time, the last ones before it tell.
    assert pace.worst(now + 9) == pytest.approx(6)


def test_the_meter_notes_work_and_stops_when_told(tmp_path):
    with_meter = Pace(tmp_path / "pace.txt")
    until = time.monotonic() + 60
    while len(with_meter.record.read_text().splitlines()) < 3 and time.monotonic() < until:
        time.sleep(0.05)
    with_meter.stop()
    assert with_meter.mean(0.0) >= 1.0
    noted = with_meter.record.read_text().splitlines()
    assert len(noted) >= 2
    end, took, busy, stop = noted[0].split()
    assert float(end) <= until
    assert 0 < float(busy) <= float(took) + 0.01
    assert stop == "."
