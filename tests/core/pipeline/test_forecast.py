# SPDX-License-Identifier: GPL-3.0-or-later
"""Time left, on a fake clock, for runs whose kinds of work cost very differently."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.pipeline.course import Course
from gskin_addon.core.pipeline.forecast import Forecast
from gskin_addon.core.pipeline.optimise_loop import TRIALS, _first_visits, work
from gskin_addon.core.skinning.presets import PRESETS

# Seconds for each piece: an easy job, one whose pictures are slow, one whose large images are slow, a slow machine.
_EASY = {
    "splats": 0.06, "initial": 1.5, "distances": 0.5, "first image": 1.2, "guidance": 0.08, "look": 1.0, 256: 0.05,
    512: 0.12, "check": 0.1, "finish": 1.0,
}  # fmt: skip
COSTS = {
    "even": _EASY,
    "slow guidance": {**_EASY, "guidance": 9.0},
    "steep in size": {**_EASY, "guidance": 0.05, "look": 0.4, 256: 0.03, 512: 0.4, "check": 0.4, "finish": 2.0},
    "many bones": {
        "splats": 0.25, "initial": 6.0, "distances": 6.0, "first image": 6.0, "guidance": 0.6, "look": 5.0, 256: 0.9,
        512: 1.5, "check": 0.5, "finish": 9.0,
    },
}  # fmt: skip


def cost(kind, table):
    word, _, size = kind.partition(" at ")
    return table["look"] if word == "look" else table[int(size)] if word == "learn" else table[word]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", COSTS)
def test_after_a_tenth_of_the_run_the_end_is_known_within_a_fifth(name, preset):
    table, rng, now, told = COSTS[name], np.random.default_rng(0), [0.0], []
    kinds = work(PRESETS[preset], 4, 50_000, 20)
    course = Course(lambda *news: told.append((now[0], news[4])), kinds, clock=lambda: now[0])

    def spend(kind):
        now[0] += cost(kind, table) * rng.uniform(0.8, 1.2)

    def do(kind):
        spend(kind)
        course.did(kind)
        course.say("stage", "")

    do("splats")
    for kind in kinds:
        for _ in range(TRIALS if kind.startswith("learn") else " at " in kind):
            spend(kind)
            course.tried(kind)
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


def test_guesses_follow_the_speed_of_what_was_measured():
    forecast = Forecast({"a": (10, 1.0), "b": (10, 2.0)})
    assert forecast.left() == pytest.approx(30)
    forecast.did("a", 6.0, 2)  # three times slower than guessed
    assert forecast.left() == pytest.approx(8 * 3 + 10 * 6)
    forecast.tried("b", 1.0)
    assert forecast.left() == pytest.approx(8 * 3 + 10)


def test_a_resumed_run_begins_where_it_stood():
    forecast = Forecast({"a": (4, 1.0), "b": (4, 1.0)})
    forecast.skip("a", 4)
    assert forecast.fraction() == pytest.approx(0.5)
    forecast.tried("b", 3.0)
    assert forecast.left() == pytest.approx(12)
    forecast.did("b", 3.0, 4)
    assert forecast.fraction() == 1.0
    assert Forecast({}).fraction() == 0.0
