# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.oracle import Oracle
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.skinning import optimise
from gskin_addon.core.skinning.fields.pyramid import SparsePyramid
from gskin_addon.core.skinning.losses import LossWeights
from gskin_addon.core.skinning.optimise import LearningOptions, Optimiser, Target
from gskin_addon.core.skinning.presets import PRESETS
from tests.helpers.limb import make_limb

PRESET = replace(PRESETS["draft"], stages=((64, 30), (128, 40)), poses_per_view=6)


@pytest.fixture(scope="module")
def task():
    limb = make_limb(1200)
    start = np.full_like(limb.weights, 0.1)
    nearest = np.abs(limb.cloud.means[:, :1] - [0.2, 1.6, 2.8]).argmin(1)  # joints in the wrong places
    start[np.arange(len(start)), nearest] = 0.8
    cameras = paper_views(*limb.cloud.bounds(), 128)
    signals = make_signals(limb.skeleton, cameras, PRESET.poses_per_view, np.random.default_rng(0))
    context = GuidanceContext(limb.cloud, limb.skeleton, start, start)
    images = Oracle(context, limb.weights).images(signals)
    targets = [Target(s.camera, s.transforms, image) for s, image in zip(signals, images, strict=True)]
    return limb, start, targets


def make(task, seed=0, preset=PRESET, held_out=(), **options):
    limb, start, targets = task
    field = SparsePyramid(limb.cloud.means, start)
    chosen = LearningOptions(seed=seed, **options)
    return Optimiser(limb.cloud, limb.skeleton, field, targets, preset, held_out=held_out, options=chosen)


def error(limb, weights):
    return float(np.abs(weights - limb.weights).sum(1).mean() / 2)


def test_perfect_guidance_recovers_the_weights(task):
    limb, start, _ = task
    optimiser = make(task)
    first = optimiser.step()
    for _ in range(PRESET.iterations - 1):
        last = optimiser.step()
    assert last["render"] < 0.5 * first["render"]
    assert error(limb, optimiser.weights()) < 0.4 * error(limb, start)
    np.testing.assert_allclose(optimiser.weights().sum(1), 1, atol=1e-5)


def test_same_seed_same_weights_other_seed_other_weights(task):
    runs = []
    for seed in (5, 5, 6):
        optimiser = make(task, seed)
        for _ in range(6):
            optimiser.step()
        runs.append(optimiser.weights())
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.abs(runs[0] - runs[2]).max() > 1e-4


def test_restored_run_ends_where_the_unbroken_one_does(task):
    whole = make(task)
    for _ in range(8):
        whole.step()
    broken = make(task)
    for _ in range(3):
        broken.step()
    state = broken.state()
    resumed = make(task)
    resumed.restore(state)
    for _ in range(5):
        resumed.step()
    np.testing.assert_array_equal(resumed.weights(), whole.weights())


def test_restored_run_with_pruning_and_held_out_poses(task, monkeypatch):
    monkeypatch.setattr(optimise, "PRUNE_FROM", 0)
    preset = replace(PRESET, stages=((64, 4), (128, 12)), batch=8)
    held = {"preset": preset, "held_out": task[2][::6]}

    def go(optimiser, until):
        while optimiser.iteration < until:
            optimiser.step()
            if optimiser.iteration % 2 == 0:
                optimiser.check()

    whole = make(task, **held)
    assert whole.visibility_updates == {0, 4}  # 24 images in batches of 8: 12 iterations are 4 epochs
    go(whole, 14)
    broken = make(task, **held)
    go(broken, 7)
    resumed = make(task, **held)
    resumed.restore(broken.state())
    go(resumed, 14)
    np.testing.assert_array_equal(resumed.weights(), whole.weights())
    assert resumed.stop.history == whole.stop.history
    whole.use_best()
    resumed.use_best()
    np.testing.assert_array_equal(resumed.weights(), whole.weights())
    assert whole.check() == pytest.approx(whole.stop.best, rel=1e-6)


def test_trying_out_changes_nothing(task):
    plain, tried = make(task), make(task)
    tried.try_out(64)
    tried.try_out(128)
    for optimiser in (plain, tried):
        for _ in range(3):
            optimiser.step()
    np.testing.assert_array_equal(plain.weights(), tried.weights())


def test_a_strong_anchor_keeps_the_initial_weights(task):
    start = task[1]
    held = make(task, losses=LossWeights(anchor=10.0))
    free = make(task)
    for _ in range(20):
        held.step()
        free.step()
    moved = [np.abs(o.weights() - start).sum(1).mean() for o in (held, free)]
    assert moved[0] < 0.25 * moved[1]
