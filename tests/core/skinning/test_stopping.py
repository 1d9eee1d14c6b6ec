# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from gskin_addon.core.skinning.stopping import EarlyStop


def test_three_checks_without_progress_end_a_run():
    stop = EarlyStop(3)
    assert stop.add(10, 1.0)
    assert stop.add(20, 0.5)
    assert not stop.add(30, 0.51)
    assert stop.add(40, 0.4995)  # the best, but hardly better
    assert stop.reason == ""
    assert not stop.add(50, 0.6)
    assert "last 3 checks" in stop.reason
    assert (stop.best, stop.best_at) == (0.4995, 40)


def test_slow_but_steady_progress_goes_on():
    stop = EarlyStop(2)
    for number in range(50):
        stop.add(number, 0.997**number)
    assert stop.reason == ""


def test_patience_of_zero_never_ends():
    stop = EarlyStop(0)
    for number in range(50):
        stop.add(number, 1.0)
    assert stop.reason == ""


def test_a_restored_one_goes_on_counting():
    first = EarlyStop(2)
    first.add(1, 1.0)
    first.add(2, 1.0)
    second = EarlyStop(2)
    second.restore(first.state())
    second.add(3, 1.0)
    assert second.reason
    assert first.reason == ""
    assert len(first.history) == 2


def test_small_images_try_nobodys_patience():
    stop = EarlyStop(2)
    for number in range(10):
        stop.add(number, 1.0, counts=False)
    stop.add(10, 1.0)
    assert stop.reason == ""
    stop.add(11, 1.0)
    assert stop.reason
