# SPDX-License-Identifier: GPL-3.0-or-later
"""The preset `paper`, end to end, with its sizes made small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.errors import Cancelled
from gskin_addon.core.pipeline import steps
from gskin_addon.core.pipeline.run import run
from gskin_addon.core.skinning import optimise, presets
from tests.helpers.limb import make_limb

SMALL = {"resolution": 16, "width": 16, "fit_steps": 15}


@pytest.fixture(autouse=True)
def small(monkeypatch):
    quick = replace(presets.PRESETS["paper"], stages=((64, 8),), poses_per_view=2, batch=4)
    monkeypatch.setitem(presets.PRESETS, "paper", quick)
    monkeypatch.setattr(steps, "GUIDANCE_SIZE", 64)


@pytest.fixture
def limb():
    return make_limb(400, 6)


@pytest.fixture
def job(limb, tmp_path):
    (tmp_path / "checkpoint").mkdir()
    np.savez(tmp_path / "truth.npz", weights=limb.weights)
    options = {"oracle_weights": str(tmp_path / "truth.npz")}
    return {"preset": "paper", "guidance": "oracle", "options": options, "field_options": SMALL}


def test_it_fits_the_field_first_and_holds_nothing_back(limb, job, tmp_path, monkeypatch):
    optimisers = []
    made = optimise.Optimiser.__init__

    def spy(self, *given, **options):
        made(self, *given, **options)
        optimisers.append(self)

    monkeypatch.setattr(optimise.Optimiser, "__init__", spy)
    told = []

    def report(stage, fraction, losses, message, left):
        told.append((message.rstrip("0123456789 of"), fraction, left))

    outcome = run(limb.cloud, limb.skeleton, job, report, tmp_path / "checkpoint")
    learned = optimisers[-1]
    assert len(learned.targets) == 4 * 2
    assert not learned._held_out.targets
    assert learned.visibility_updates == frozenset()
    assert learned._neighbours.shape[1] == 30
    assert (learned.losses.anchor, learned.losses.arap_nodes) == (0, 0)
    assert float(learned.field._prior.abs().max()) == 0
    said = outcome.report
    assert (said["field"], said["iterations"], said["held_out"]) == ("volume", 8, [])
    assert said["start"] == "initial weights (visibility)"
    assert set(said["losses"][0]) == {"iteration", "render", "arap", "coupling"}
    assert 0 < said["fit"]["steps"] <= 15
    assert (outcome.weights > 0).sum(axis=1).max() > 4  # no limit of bones
    words = [message for message, *_ in told]
    fit = [n for n, word in enumerate(words) if word.startswith("Fitting")]
    first = next(n for n, word in enumerate(words) if word.startswith("Iteration"))
    assert 0 < fit[0] < fit[-1] < first
    assert told[fit[0]][1] < told[fit[-1]][1] <= told[first][1]


def test_a_fit_can_be_cancelled(limb, job, tmp_path):
    def report(stage, fraction, losses, message, left):
        if message.startswith("Fitting"):
            raise Cancelled("now")

    with pytest.raises(Cancelled):
        run(limb.cloud, limb.skeleton, job, report, tmp_path / "checkpoint")


def test_what_was_learned_is_not_fitted_again(limb, job, tmp_path, monkeypatch):
    monkeypatch.setattr("gskin_addon.core.pipeline.optimise_loop.CHECKPOINT_SECONDS", -1e9)
    monkeypatch.setattr("gskin_addon.core.pipeline.optimise_loop.CHECKPOINT_SHARE", 1e9)
    (tmp_path / "other").mkdir()
    whole = run(limb.cloud, limb.skeleton, job, lambda *_: None, tmp_path / "other")
    fits = []

    def report(stage, fraction, losses, message, left):
        fits.append(message.startswith("Fitting"))
        if message.startswith("Iteration 5"):
            raise Cancelled("now")

    with pytest.raises(Cancelled):
        run(limb.cloud, limb.skeleton, job, report, tmp_path / "checkpoint")
    assert any(fits)
    fits.clear()
    resumed = run(limb.cloud, limb.skeleton, job, lambda *news: fits.append(news[3].startswith("Fitting")),
                  tmp_path / "checkpoint")  # fmt: skip
    assert not any(fits)
    np.testing.assert_array_equal(resumed.weights, whole.weights)


@pytest.mark.parametrize("views", [1, 2, 6])
def test_guidance_images_are_of_as_many_views(limb, job, views, tmp_path):
    job["field_options"] = {**SMALL, "fit_steps": 1}
    outcome = run(limb.cloud, limb.skeleton, {**job, "views": views}, lambda *_: None, tmp_path / "checkpoint")
    assert outcome.report["guidance_images"] == 2 * views
