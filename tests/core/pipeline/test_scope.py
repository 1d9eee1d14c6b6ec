# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs that start from present weights, and jobs that may change some splats only."""

from __future__ import annotations

import numpy as np
import pytest
from proxy_meshes import tube
from worker_jobs import write_scope

from gskin_addon.core.errors import InputError
from gskin_addon.core.job.mesh_files import write_mesh
from gskin_addon.core.job.scope import Scope
from gskin_addon.core.pipeline import steps
from gskin_addon.core.pipeline.run import run
from gskin_addon.core.skinning import presets
from tests.helpers.limb import make_limb

ELASTIC = {"preset": "draft", "guidance": "elastic"}
TINY = presets.Preset("for tests", 4, ((64, 6), (128, 10)), 4)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "draft", TINY)
    monkeypatch.setattr(steps, "GUIDANCE_SIZE", 128)


def silent(*_):
    return None


def noisy(weights):
    """Weights of more bones than a job leaves: what an artist may have painted."""
    mixed = 0.7 * weights + 0.3 / weights.shape[1]
    return (mixed / mixed.sum(axis=1, keepdims=True)).astype(np.float32)


def job(tmp_path, limb, scope, settings):
    checkpoint = tmp_path / "checkpoint"
    checkpoint.mkdir(exist_ok=True)
    settings = {**settings, "scope": write_scope(tmp_path, scope)}
    return run(limb.cloud, limb.skeleton, settings, silent, checkpoint)


def test_present_weights_stay_where_nothing_is_learned(tmp_path):
    limb = make_limb(400)
    start = noisy(limb.weights)
    outcome = job(tmp_path, limb, Scope(start), {"init": "present", "max_influences": 0})
    np.testing.assert_array_equal(outcome.weights, start)
    assert outcome.confidence is None


def test_splats_without_present_weights_start_as_their_nearest_neighbours_do(tmp_path):
    limb = make_limb(400)
    start = noisy(limb.weights)
    empty = np.arange(400) % 7 == 0
    known = np.where(empty[:, None], 0, start).astype(np.float32)
    outcome = job(tmp_path, limb, Scope(known, np.flatnonzero(empty)), {"init": "present", "max_influences": 0})
    way = np.linalg.norm(limb.cloud.means[empty, None] - limb.cloud.means[~empty], axis=2)
    np.testing.assert_array_equal(outcome.weights[empty], start[~empty][way.argmin(axis=1)])
    np.testing.assert_array_equal(outcome.weights[~empty], start[~empty])


@pytest.mark.parametrize("settings", [{}, {"init": "geodesic"}, ELASTIC, {**ELASTIC, "init": "present"}])
def test_only_the_chosen_splats_change(tmp_path, settings):
    limb = make_limb(600)
    start = noisy(limb.weights)
    only = np.arange(100, 300)
    outcome = job(tmp_path, limb, Scope(start, only), {**settings, "max_influences": 2})
    rest = np.setdiff1d(np.arange(600), only)
    np.testing.assert_array_equal(outcome.weights[rest], start[rest])
    assert np.abs(outcome.weights[only] - start[only]).sum(axis=1).min() > 0
    assert (outcome.weights[only] > 0).sum(axis=1).max() <= 2
    np.testing.assert_allclose(outcome.weights.sum(axis=1), 1, atol=1e-5)


def test_learning_starts_from_the_present_weights(tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "draft", presets.Preset("for tests", 4, ((64, 2),), 4))
    limb = make_limb(600)
    start = noisy(np.roll(limb.weights, 1, axis=1))  # every splat on the wrong bone: two steps do not bring it back
    outcome = job(tmp_path, limb, Scope(start), {**ELASTIC, "init": "present", "max_influences": 0})
    change = np.abs(outcome.weights - start).sum(axis=1).mean()
    assert 0.01 < change < 0.5 * np.abs(limb.weights - start).sum(axis=1).mean()


def test_what_is_missing_is_named(tmp_path):
    limb = make_limb(100)
    with pytest.raises(InputError, match=r"init is 'present'.*no scope"):
        run(limb.cloud, limb.skeleton, {"init": "present"}, silent, tmp_path / "checkpoint")
    with pytest.raises(InputError, match="no present weights to start from"):
        job(tmp_path, limb, Scope(walls=np.zeros(100, np.int64)), {"init": "present"})
    verts, faces = tube(rings=12)
    settings = {**ELASTIC, "mesh": write_mesh(tmp_path, verts, faces)}
    with pytest.raises(InputError, match="leave the scope"):
        job(tmp_path, limb, Scope(noisy(limb.weights)), settings)


@pytest.mark.parametrize("settings", [{}, ELASTIC])
def test_walls_keep_what_touches_apart(tmp_path, settings):
    limb = make_limb(900)
    walls = np.where(limb.cloud.means[:, 0] < 1.5, 1, 2)  # across the middle bone
    settings = {**settings, "max_influences": 0}
    checkpoint = tmp_path / "free" / "checkpoint"
    checkpoint.mkdir(parents=True)
    free = run(limb.cloud, limb.skeleton, settings, silent, checkpoint)
    walled = job(tmp_path, limb, Scope(walls=walls), settings)
    # Beyond the wall the first bone is out of reach.
    beyond = walls == 2
    assert walled.weights[beyond, 0].max() < free.weights[beyond, 0].max()
    assert np.abs(walled.weights - free.weights).sum(axis=1).max() > 0.05
    np.testing.assert_allclose(walled.weights.sum(axis=1), 1, atol=1e-5)
