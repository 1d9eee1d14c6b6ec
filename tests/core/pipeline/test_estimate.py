# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a job will take, said before it starts."""

from __future__ import annotations

import re

import pytest
from without import output_without

from gskin_addon.core.job.settings import JobSettings
from gskin_addon.core.pipeline.estimate import estimate_seconds, in_words, warning_of_time
from gskin_addon.core.pipeline.work_kinds import CHECKS, checks_of
from gskin_addon.core.skinning.presets import PRESETS


def test_more_splats_bones_and_images_take_longer():
    def seconds(splats=50_000, bones=20, **settings) -> float:
        return estimate_seconds(JobSettings(**settings), splats, bones)

    assert 1 < seconds(1000) < seconds() < seconds(400_000) < 60
    guided = [seconds(guidance="elastic", preset=name) for name in ("draft", "standard", "high", "thorough", "paper")]
    assert seconds() < guided[0]
    assert guided == sorted(guided)
    assert seconds(guidance="elastic", bones=100) > seconds(guidance="elastic")
    assert seconds(mesh="mesh.npz") > 4  # torch has to be loaded
    # Learning is on a part of very many splats.
    assert seconds(10**6, guidance="elastic") == seconds(5 * 10**5, guidance="elastic")


def test_images_of_diffusion_models_are_not_guessed():
    assert estimate_seconds(JobSettings(guidance="flux_repair"), 50_000, 20) is None
    assert in_words(None) == ""


def test_the_volume_says_what_it_costs_before_it_starts():
    paper = JobSettings.parse({"preset": "paper", "guidance": "lightning_drag"})
    told = warning_of_time(paper, 50_000, 20)
    hour, memory, fast = (float(number) for number in re.findall(r"[\d.]+(?= min| GB)", told))
    assert hour > 3 * fast
    assert 1 < memory < 16
    assert "'pyramid'" in told
    more = [warning_of_time(paper, splats, bones) for splats, bones in ((150_000, 20), (50_000, 100))]
    assert min(float(re.search(r"(\d+) min", words).group(1)) for words in more) > hour
    assert estimate_seconds(JobSettings.parse({"preset": "paper", "guidance": "elastic"}), 50_000, 20) > 60 * hour
    for quick in ({"preset": "paper"}, {"preset": "thorough", "guidance": "elastic"}):
        assert warning_of_time(JobSettings.parse(quick), 50_000, 20) == ""


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "about 1 s"), (6.4, "about 6 s"), (62, "about 60 s"), (100, "about 2 min"), (1500, "about 25 min")],
)
def test_words(seconds, words):
    assert in_words(seconds) == words


@pytest.mark.parametrize("preset", PRESETS.values(), ids=list(PRESETS))
def test_checks_are_ten_and_end_with_the_run(preset):
    assert len(checks_of(preset)) == CHECKS
    assert max(checks_of(preset)) == preset.iterations


def test_needs_no_torch():
    program = "import gskin_addon.core.pipeline.estimate; print('told')"
    assert "told" in output_without(("torch", "numba", "scipy"), program)
