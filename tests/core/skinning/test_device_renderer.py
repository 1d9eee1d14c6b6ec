# SPDX-License-Identifier: GPL-3.0-or-later
"""Optimisation with a rasteriser that takes torch tensors, here Warp on its "cpu" device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("warp")

from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.oracle import Oracle
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.pipeline.run import run
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.skinning import device_renderer
from gskin_addon.core.skinning.fields.pyramid import SparsePyramid
from gskin_addon.core.skinning.optimise import LearningOptions, Optimiser, Target
from gskin_addon.core.skinning.presets import PRESETS
from tests.helpers.limb import make_limb

PRESET = replace(PRESETS["draft"], stages=((32, 2), (64, 2)), poses_per_view=1, batch=3)


@pytest.fixture(autouse=True)
def _on_the_processor(monkeypatch):
    monkeypatch.setenv("GSKIN_WARP_DEVICE", "cpu")


@pytest.fixture(scope="module", params=[0, 1], ids=["one_scene", "a_scene_per_view"])
def task(request):
    limb = make_limb(300)
    start = np.full_like(limb.weights, 1 / limb.weights.shape[1])
    cameras = paper_views(*limb.cloud.bounds(), 64)
    signals = make_signals(limb.skeleton, cameras, PRESET.poses_per_view, np.random.default_rng(0))
    images = Oracle(GuidanceContext(limb.cloud, limb.skeleton, start, start), limb.weights).images(signals)
    targets = [Target(s.camera, s.transforms, image) for s, image in zip(signals, images, strict=True)]
    cloud = limb.cloud
    if request.param:
        more = np.random.default_rng(1).normal(0, 0.2, (cloud.count, 3, 3)).astype(np.float32)
        cloud = replace(cloud, sh=np.concatenate([cloud.sh[:, :1], more], axis=1))
    return cloud, limb.skeleton, start, targets


def steps(task, rasterizer):
    cloud, skeleton, start, targets = task
    field, options = SparsePyramid(cloud.means, start), LearningOptions(rasterizer=rasterizer)
    optimiser = Optimiser(cloud, skeleton, field, targets, PRESET, options=options)
    return optimiser, [optimiser.step() for _ in range(PRESET.iterations)]


def test_the_device_learns_what_the_cpu_learns(task):
    cpu, wanted = steps(task, "cpu")
    device, found = steps(task, "warp")
    assert device._device_renderer is not None
    assert cpu._device_renderer is None
    for mine, theirs in zip(found, wanted, strict=True):
        assert mine == pytest.approx(theirs, rel=1e-4)
    start = task[2]
    learned = np.abs(cpu.weights() - start).max()
    assert learned > 0.05
    # Adam's first steps take the sign of a gradient, so the few splats that no picture needs may differ.
    difference = np.abs(device.weights() - cpu.weights())
    assert np.percentile(difference, 99) < 0.01 * learned


def test_a_gpu_that_only_warp_has_takes_arrays(task, monkeypatch):
    _, wanted = steps(task, "cpu")
    monkeypatch.setattr(device_renderer.torch.cuda, "is_available", lambda: False)

    class Scene:
        tensor_device = "cuda:0"

    assert device_renderer.tensor_device(Scene()) is None
    monkeypatch.setattr("gskin_addon.core.skinning.optimise.tensor_device", lambda scene: None)
    device, found = steps(task, "warp")
    assert device._device_renderer is None
    for mine, theirs in zip(found, wanted, strict=True):
        assert mine == pytest.approx(theirs, rel=1e-4)


def test_a_job_says_what_drew(tmp_path, monkeypatch):
    from gskin_addon.core.pipeline import steps
    from gskin_addon.core.skinning import presets

    monkeypatch.setitem(presets.PRESETS, "draft", PRESET)
    monkeypatch.setattr(steps, "GUIDANCE_SIZE", 64)
    limb = make_limb(300)
    settings = {"preset": "draft", "guidance": "elastic", "rasterizer": "warp"}
    outcome = run(limb.cloud, limb.skeleton, settings, lambda *_: None, tmp_path)
    assert outcome.report["rasterizer"] == {"name": "warp", "remark": ""}
    assert outcome.report["settings"]["rasterizer"] == "warp"
