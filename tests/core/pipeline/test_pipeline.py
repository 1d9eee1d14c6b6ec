# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.errors import Cancelled, InputError
from gskin_addon.core.pipeline import optimise_loop, steps
from gskin_addon.core.pipeline.run import run
from gskin_addon.core.pipeline.steps import to_unit_size
from gskin_addon.core.render import backends
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.influences import Influences
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_points, sparsify
from gskin_addon.core.rig.poses import random_poses
from gskin_addon.core.skinning import presets, subset
from gskin_addon.core.skinning.initial import initial_weights
from gskin_addon.core.skinning.learned.predict import heat_weights, learned_weights
from tests.helpers.limb import make_limb

ELASTIC = {"preset": "draft", "guidance": "elastic"}
TINY = presets.Preset("for tests", 4, ((64, 6), (128, 10)), 4)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "draft", TINY)
    monkeypatch.setattr(steps, "GUIDANCE_SIZE", 128)


def silent(*_):
    return None


def position_error(limb, weights):
    rng = np.random.default_rng(1)
    poses = pose_transforms(limb.skeleton, random_poses(limb.skeleton, (0, 1, 0), 20, rng))
    moved = [skin_points(limb.cloud.means, w, poses) for w in (weights, limb.weights)]
    return float(np.linalg.norm(moved[0] - moved[1], axis=-1).mean())


def test_without_images_a_job_ends_with_its_initial_weights(tmp_path):
    limb = make_limb(1500)
    told = []
    outcome = run(limb.cloud, limb.skeleton, {"max_influences": 0}, lambda *news: told.append(news), tmp_path)
    learned, confidence = learned_weights(*to_unit_size(limb.cloud, limb.skeleton))
    np.testing.assert_allclose(outcome.weights, learned, atol=1e-6)
    np.testing.assert_allclose(outcome.confidence, confidence, atol=1e-6)
    assert outcome.report["guidance_images"] == outcome.report["splats_optimised"] == 0
    assert not outcome.previews, "nothing was rendered"
    assert {stage for stage, *_ in told} == {"initial", "finish"}
    assert not list(tmp_path.iterdir()), "nothing to resume was left"


def test_the_result_says_what_it_started_from(tmp_path):
    limb = make_limb(700)
    outcome = run(limb.cloud, limb.skeleton, {}, silent, tmp_path)
    heat = heat_weights(*to_unit_size(limb.cloud, limb.skeleton))
    assert outcome.report["start"] == "bone heat"
    np.testing.assert_allclose(outcome.start.dense(limb.skeleton.count), sparsify(heat, 4), atol=1e-5)
    assert np.abs(outcome.start.dense(limb.skeleton.count) - outcome.weights).max() > 0.05
    assert run(limb.cloud, limb.skeleton, {"init": "heat"}, silent, tmp_path).start is None


def test_a_guided_result_started_from_its_initial_weights(tmp_path):
    limb = make_limb(700)
    outcome = run(limb.cloud, limb.skeleton, ELASTIC, silent, tmp_path)
    plain = run(limb.cloud, limb.skeleton, {}, silent, tmp_path).weights
    assert outcome.report["start"] == "initial weights (learned)"
    np.testing.assert_allclose(outcome.start.dense(limb.skeleton.count), plain, atol=1e-5)


def test_pictures_are_there_while_it_runs(tmp_path):
    """The newest guidance image from the first one on, the weights from the first iteration on."""
    limb, seen = make_limb(500), {}

    def watch(stage, *_):
        seen[stage] = {path.name: path.stat().st_size for path in (tmp_path / "previews").glob("*.png")}

    run(limb.cloud, limb.skeleton, ELASTIC, watch, tmp_path / "checkpoint")
    assert not seen["initial"]
    assert set(seen["guidance"]) == {"guidance.png"}
    assert set(seen["optimise"]) == {"guidance.png", "weights.png"}
    assert min(seen["optimise"].values()) > 500


def test_stray_splats_start_from_where_the_body_does(tmp_path):
    limb = make_limb(700)
    means = limb.cloud.means.copy()
    means[:3] += 30
    job = steps.JobInputs.read(replace(limb.cloud, means=means), limb.skeleton, {}, tmp_path / "c")
    splats = steps.prepare_splats(job)
    assert splats.ignored[:3].all()
    start = Influences(np.arange(700, dtype=np.int32)[:, None], np.ones((700, 1), np.float32))
    followed = steps.finish_start(job, splats, start).index[:, 0]
    assert not splats.ignored[followed].any()
    np.testing.assert_array_equal(followed[~splats.ignored], np.flatnonzero(~splats.ignored))


def test_confidence_falls_where_images_disagree(tmp_path):
    limb = make_limb(800)
    outcome = run(limb.cloud, limb.skeleton, ELASTIC, silent, tmp_path)
    _, before = learned_weights(*to_unit_size(limb.cloud, limb.skeleton))
    assert outcome.confidence.shape == (800,)
    assert (outcome.confidence <= before + 1e-6).all()
    assert outcome.confidence.mean() < before.mean()
    assert run(limb.cloud, limb.skeleton, {"init": "geodesic"}, silent, tmp_path).confidence is None


def test_elastic_guidance_learns(tmp_path):
    limb = make_limb(1500)
    start = run(limb.cloud, limb.skeleton, ELASTIC, silent, tmp_path)
    report = start.report
    assert start.weights.shape == limb.weights.shape
    np.testing.assert_allclose(start.weights.sum(1), 1, atol=1e-5)
    assert report["guidance_images"] == 16
    assert report["iterations"] == 16
    assert report["losses"][-1]["render"] < report["losses"][0]["render"]
    assert set(start.previews) == {"weights", "guidance"}
    assert position_error(limb, start.weights) < 0.05


@pytest.mark.parametrize("limit", [10_000, 700])
def test_the_oracle_keeps_the_order_of_the_splats(tmp_path, monkeypatch, limit):
    """Splats are reordered, and some left out, inside a job; known weights must follow."""
    monkeypatch.setattr(subset, "LIMIT", limit)
    monkeypatch.setitem(presets.PRESETS, "draft", replace(TINY, stages=((128, 40),)))
    limb = make_limb(1500)
    np.savez(tmp_path / "truth.npz", weights=limb.weights)
    options = {"oracle_weights": str(tmp_path / "truth.npz")}
    settings = {"preset": "draft", "guidance": "oracle", "options": options}
    learned = run(limb.cloud, limb.skeleton, settings, silent, tmp_path).weights
    cameras = paper_views(*limb.cloud.bounds(), 128)
    masks = np.stack([render_cloud(limb.cloud, camera)[1] > 0.5 for camera in cameras])
    start = initial_weights("visibility", limb.cloud, limb.skeleton, masks, cameras)
    assert position_error(limb, learned) < 0.5 * position_error(limb, start)


def test_result_does_not_depend_on_place_and_unit(tmp_path):
    limb = make_limb(800)
    here = run(limb.cloud, limb.skeleton, ELASTIC, silent, tmp_path)
    far = replace(limb.cloud, means=limb.cloud.means * 50 + 7, scales=limb.cloud.scales * 50)
    moved = limb.skeleton.moved(np.eye(3), 50.0, (7, 7, 7))
    there = run(far, moved, ELASTIC, silent, tmp_path / "other")
    assert np.abs(here.weights - there.weights).sum(1).mean() < 0.05


def test_a_stopped_run_goes_on_and_ends_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(optimise_loop, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(optimise_loop, "CHECKPOINT_SHARE", np.inf)
    limb = make_limb(800)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    whole = run(limb.cloud, limb.skeleton, ELASTIC, silent, tmp_path / "a")

    def stop(stage, fraction, losses, message, left):
        if message.startswith("Iteration 9 "):
            raise Cancelled("stop")

    with pytest.raises(Cancelled):
        run(limb.cloud, limb.skeleton, ELASTIC, stop, tmp_path / "b")
    iterations = []

    def watch(stage, fraction, losses, message, left):
        if stage == "optimise":
            iterations.append(message)

    resumed = run(limb.cloud, limb.skeleton, ELASTIC, watch, tmp_path / "b")
    assert iterations[0].startswith("Iteration 10 ")
    np.testing.assert_array_equal(resumed.weights, whole.weights)


def test_strays_are_ignored_and_follow_the_body(tmp_path):
    limb = make_limb(800)
    far = limb.cloud.select(np.array([5, 700]))
    both = [
        np.concatenate([getattr(limb.cloud, name), getattr(far, name)])
        for name in ("means", "quats", "scales", "opacities", "sh")
    ]
    both[0][800:] += (0, 0, 1.0)
    outcome = run(type(limb.cloud)(*both), limb.skeleton, ELASTIC, silent, tmp_path)
    assert outcome.report["hygiene"] == {"strays": 2, "faint_giants": 0}
    assert outcome.report["splats"] == 802
    assert outcome.report["splats_optimised"] == 800
    near = np.linalg.norm(limb.cloud.means - both[0][800:, None], axis=-1).argmin(1)
    np.testing.assert_array_equal(outcome.weights[800:], outcome.weights[near])


def test_needles_are_clamped_for_learning(tmp_path):
    limb = make_limb(400)
    scales = limb.cloud.scales.copy()
    scales[:7, 0] *= 50
    settings = {**ELASTIC, "hygiene": {"max_aspect": 10, "ignore_strays": False}}
    report = run(replace(limb.cloud, scales=scales), limb.skeleton, settings, silent, tmp_path).report
    assert report["hygiene"] == {"faint_giants": 0, "needles": 7}


def test_the_volume_can_be_asked_for(tmp_path):
    limb = make_limb(400)
    options = {"resolution": 16, "width": 32}
    settings = {**ELASTIC, "field": "volume", "field_options": options}
    report = run(limb.cloud, limb.skeleton, settings, silent, tmp_path).report
    assert report["field"] == "volume"
    assert report["settings"]["field_options"] == options


def test_influences_are_limited(tmp_path):
    limb = make_limb(600)
    outcome = run(limb.cloud, limb.skeleton, {**ELASTIC, "max_influences": 2}, silent, tmp_path)
    assert (outcome.weights > 0).sum(1).max() <= 2


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"preset": "fastest"}, "preset is 'fastest'"),
        ({"guidance": "magic"}, "guidance is 'magic'"),
        ({"init": "random"}, "init is 'random'"),
        ({"front": "up"}, "front is 'up'"),
        ({"max_influences": -1}, "max_influences"),
        ({"sed": 3}, "unknown settings sed"),
        ({"field": "grid"}, "field is 'grid'"),
        ({**ELASTIC, "field_options": {"size": 3}}, "no option size"),
        ({"hygiene": {"strays": True}}, "no option strays"),
        ({"losses": {"arp": 1}}, "no option arp"),
        ({"losses": {"arap": -1}}, "arap is -1; use a number from 0"),
        ({"losses": {"arap_neighbours": 2.5}}, "arap_neighbours is 2.5; use a whole number"),
        ({"losses": {"dssim": 1.5}}, "dssim is 1.5"),
    ],
)
def test_bad_settings_are_named(tmp_path, settings, words):
    limb = make_limb(50)
    with pytest.raises(InputError, match=words):
        run(limb.cloud, limb.skeleton, settings, silent, tmp_path)


def test_a_rasterizer_that_is_not_there_is_refused_before_any_work(tmp_path, monkeypatch):
    limb = make_limb(300)
    with pytest.raises(InputError, match="rasterizer is 'ray'; choose one of auto, cpu"):
        run(limb.cloud, limb.skeleton, {"rasterizer": "ray"}, silent, tmp_path)
    monkeypatch.setattr(backends, "cuda_device", lambda: "")
    monkeypatch.delenv(backends.WARP_DEVICE, raising=False)
    with pytest.raises(InputError, match="warp"):
        run(limb.cloud, limb.skeleton, {"rasterizer": "warp"}, silent, tmp_path)
