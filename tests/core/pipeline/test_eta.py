# SPDX-License-Identifier: GPL-3.0-or-later
"""Time left, on a fake clock, for runs whose kinds of work cost very differently."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.pipeline.eta import Eta, StageEta
from gskin_addon.core.pipeline.optimise_loop import TRIALS, _first_visits
from gskin_addon.core.pipeline.work_kinds import guided_kinds
from gskin_addon.core.skinning.presets import PRESETS

# Seconds for each piece: an easy job, one whose pictures are slow, one whose large images are slow, a slow machine.
_EASY = {
    "splats": 0.06, "initial": 1.5, "distances": 0.5, "first image": 1.2, "guidance": 0.08, "visibility": 1.0,
    256: 0.05, 512: 0.12, "check": 0.1, "finish": 1.0,
}  # fmt: skip
COSTS = {
    "even": _EASY,
    "slow guidance": {**_EASY, "guidance": 9.0},
    "steep in size": {**_EASY, "guidance": 0.05, "visibility": 0.4, 256: 0.03, 512: 0.4, "check": 0.4, "finish": 2.0},
    "many bones": {
        "splats": 0.25, "initial": 6.0, "distances": 6.0, "first image": 6.0, "guidance": 0.6, "visibility": 5.0,
        256: 0.9, 512: 1.5, "check": 0.5, "finish": 9.0,
    },
}  # fmt: skip


def cost(kind, table):
    word, _, size = kind.partition(" at ")
    return table["visibility"] if word == "visibility" else table[int(size)] if word == "learn" else table[word]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", COSTS)
def test_after_a_tenth_of_the_run_the_end_is_known_within_a_fifth(name, preset):
    table, rng, now, told = COSTS[name], np.random.default_rng(0), [0.0], []
    kinds = {"splats": (1, 0.06), "initial": (1, 1.1)} | guided_kinds(PRESETS[preset], 4, 50_000, 20)
    kinds["finish"] = (1, 0.8)
    eta = Eta(lambda *news: told.append((now[0], news[4])), kinds, clock=lambda: now[0])

    def spend(kind):
        now[0] += cost(kind, table) * rng.uniform(0.8, 1.2)

    def do(kind):
        spend(kind)
        eta.record(kind)
        eta.report("stage", "")

    do("splats")
    for kind in kinds:
        for _ in range(TRIALS if kind.startswith("learn") else " at " in kind):
            spend(kind)
            eta.record_trial(kind)
    for kind in kinds:
        for _ in range(kinds[kind][0] - (kind == "splats")):
            do(kind)
    early = [(at, left) for at, left in told if at >= now[0] / 10]
    for at, left in early[: len(early) // 2]:
        assert left == pytest.approx(now[0] - at, rel=0.2)
    assert told[-1][1] == pytest.approx(0, abs=1e-9)


def test_each_image_is_met_first_in_the_first_epoch_of_a_size():
    preset = replace(PRESETS["standard"], stages=((256, 80), (512, 120)), batch=4)
    assert _first_visits(preset, 96) == {*range(24), *range(80, 104)}
    assert _first_visits(replace(preset, stages=((512, 3),)), 96) == {0, 1, 2}


class Clock:
    """A clock that is set by hand, and an Eta on it."""

    def __init__(self, kinds):
        self.now = 0.0
        self.eta = Eta(lambda *_: None, kinds, clock=lambda: self.now)

    def record(self, kind, seconds, pieces=1):
        self.now += seconds
        self.eta.record(kind, pieces)

    def record_trial(self, kind, seconds):
        self.now += seconds
        self.eta.record_trial(kind)


def test_guesses_follow_the_speed_of_what_was_measured():
    clock = Clock({"a": (10, 1.0), "b": (10, 2.0)})
    assert clock.eta.seconds_left() == pytest.approx(30)
    clock.record("a", 6.0, 2)  # three times slower than guessed
    assert clock.eta.seconds_left() == pytest.approx(8 * 3 + 10 * 6)
    clock.record_trial("b", 1.0)
    assert clock.eta.seconds_left() == pytest.approx(8 * 3 + 10)


def test_a_resumed_run_begins_where_it_stood():
    clock = Clock({"a": (4, 1.0), "b": (4, 1.0)})
    clock.eta.skip("a", 4)
    assert clock.eta.fraction() == pytest.approx(0.5)
    clock.record_trial("b", 3.0)
    assert clock.eta.seconds_left() == pytest.approx(12)
    clock.record("b", 3.0, 4)
    assert clock.eta.fraction() == 1.0
    assert Clock({}).eta.fraction() == 0.0


def test_a_machine_that_gets_busy_after_the_trials_is_noticed():
    clock = Clock({"small": (80, 0.1), "large": (120, 0.3)})
    for _ in range(3):
        clock.record_trial("small", 0.1)
        clock.record_trial("large", 0.3)
    for _ in range(40):
        clock.record("small", 0.15)  # half as slow again as when it was tried
    assert clock.eta.seconds_left() == pytest.approx(40 * 0.15 + 120 * 0.45, rel=0.05)
    for _ in range(40):
        clock.record("small", 0.1)
    for _ in range(30):
        clock.record("large", 0.3)
    for _ in range(30):
        clock.record("large", 0.6)
    assert clock.eta.seconds_left() == pytest.approx(60 * 0.6, rel=0.2)


def test_parts_of_a_piece_move_the_bar():
    clock = Clock({"one": (1, 1.0), "rest": (1, 1.0)})
    for step in range(1, 5):
        clock.now += 0.5
        clock.eta.record_up_to("one", step / 4)
        assert clock.eta.fraction() == pytest.approx(step / 8)
    clock.eta.record_up_to("one", 0.5)  # never falls
    assert clock.eta.fraction() == pytest.approx(0.5)
    assert clock.eta.seconds_left() == pytest.approx(2.0)


def follow(fractions, step):
    """Seconds left that a StageEta says at the last of the fractions, one each `step` seconds."""
    now = [0.0]
    eta = StageEta(clock=lambda: now[0])
    left = None
    for fraction in fractions:
        left = eta.seconds_left(fraction)
        now[0] += step
    return left


def test_steady_work_is_foreseen():
    assert follow(np.arange(0.0, 0.6, 0.005), 0.5) == pytest.approx(100 - 59.5, rel=0.02)


def test_a_slower_stage_is_noticed():
    # 10 s for the first half, then 100 s for the second: 30 s into it, 80 s are left, not 12.
    times = np.arange(0.0, 30.0, 0.25)
    assert follow(np.minimum(times / 20, 0.5 + (times - 10) / 200), 0.25) == pytest.approx(80, rel=0.2)


def test_a_resumed_job_is_not_taken_for_a_fast_one():
    assert follow(0.9 + np.arange(0.0, 10.0, 0.25) / 1000, 0.25) == pytest.approx(90, rel=0.05)


def test_nothing_is_said_without_a_measure():
    assert follow([0.0], 0.5) is None
    assert follow([0.0, 0.5], 0.5) is None  # half a second proves nothing
    assert follow([1.0], 9.0) is None
