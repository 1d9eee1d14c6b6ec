# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.oracle import Oracle
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.skinning.fields import WEIGHT_FIELDS, create_field
from gskin_addon.core.skinning.fields.volume import WeightVolume, decoder_widths
from gskin_addon.core.skinning.optimise import Optimiser, Target
from gskin_addon.core.skinning.presets import PRESETS
from tests.helpers.limb import make_limb

SMALL = {"resolution": 32, "width": 128}


def disturbed(limb):
    """Weights with the joints in the wrong places."""
    start = np.full_like(limb.weights, 0.1)
    start[np.arange(len(start)), np.abs(limb.cloud.means[:, :1] - [0.2, 1.6, 2.8]).argmin(1)] = 0.8
    return start


def error(limb, weights):
    return float(np.abs(weights - limb.weights).sum(1).mean() / 2)


def test_the_paper_decoder():
    """HumanNeRF's widths; 66.5 million parameters, less the first layer's taps that meet nothing."""
    assert decoder_widths(128) == [512, 512, 256, 256, 128, 128]
    limb = make_limb(50)
    field = WeightVolume(limb.cloud.means, limb.weights, 32)
    hidden = 256 + 257 * 1024 + 1025 * 8 * 512
    convolutions = 64 * (512 * 512 + 512 * 256 + 256 * 256 + 256 * 3)
    biases = 512 + 256 + 256 + 3
    assert sum(p.numel() for p in field.parameters()) == hidden + convolutions + biases


def test_starts_at_the_initial_weights():
    limb = make_limb(300)
    start = disturbed(limb)
    field = WeightVolume(limb.cloud.means, start, **SMALL)
    np.testing.assert_allclose(field().detach(), start, rtol=1e-4, atol=1e-6)


def test_gradient_reaches_every_parameter():
    limb = make_limb(200)
    field = WeightVolume(limb.cloud.means, disturbed(limb), 16, 32)
    adam = torch.optim.Adam(field.parameters(), lr=1e-3)
    target = torch.from_numpy(limb.weights)
    for _ in range(2):  # the zero last layer lets nothing through in the first step
        adam.zero_grad()
        (field() - target).square().sum().backward()
        adam.step()
    for name, parameter in field.named_parameters():
        assert float(parameter.grad.abs().max()) > 0, name


def test_fit_is_the_papers_warm_up():
    limb = make_limb(400)
    start = disturbed(limb)
    field = WeightVolume(limb.cloud.means, start, 16, 64, start="fit", fit_steps=300)
    told = field.fit()
    assert 0 < told["steps"] <= 300
    assert float(field._prior.abs().max()) == 0
    assert np.abs(field().detach().numpy() - start).mean() < 0.06  # the steps in them are 0.7 high


def test_the_fit_tells_how_far_it_is_and_ends_when_it_is_good():
    limb = make_limb(300)
    start = disturbed(limb)
    ticks: list[float] = []
    field = WeightVolume(limb.cloud.means, start, 16, 64, start="fit", fit_steps=5)
    assert field.fit(ticks.append)["steps"] == 5
    np.testing.assert_allclose(ticks, [0.2, 0.4, 0.6, 0.8, 1.0])
    # A body that one bone moves is fitted within few steps.
    still = np.tile(np.float32([1, 0, 0]), (300, 1))
    field = WeightVolume(limb.cloud.means, still, 16, 64, start="fit", fit_steps=300)
    told = field.fit()
    assert told["steps"] < 100
    assert told["error"] == pytest.approx(np.sqrt(np.square(field().detach().numpy() - still).mean()), abs=1e-3)
    assert WeightVolume(limb.cloud.means, start, **SMALL).fit() == {}


def test_without_a_prior_the_initial_weights_are_still_known():
    """They are what splats keep that may not change, and what an anchor pulls to."""
    limb = make_limb(200)
    start = disturbed(limb)
    field = WeightVolume(limb.cloud.means, start, 16, 64, start="fit")
    np.testing.assert_allclose(field.initial(), start, rtol=1e-4, atol=1e-4)


def test_it_learns_the_limb_from_perfect_guidance():
    limb = make_limb(1200)
    start = disturbed(limb)
    preset = replace(PRESETS["draft"], stages=((64, 30), (128, 40)), poses_per_view=6)
    cameras = paper_views(*limb.cloud.bounds(), 128)
    signals = make_signals(limb.skeleton, cameras, preset.poses_per_view, np.random.default_rng(0))
    images = Oracle(GuidanceContext(limb.cloud, limb.skeleton, start, start), limb.weights).images(signals)
    targets = [Target(s.camera, s.transforms, image) for s, image in zip(signals, images, strict=True)]
    field = create_field("volume", limb.cloud.means, start, SMALL)
    optimiser = Optimiser(limb.cloud, limb.skeleton, field, targets, preset)
    for _ in range(preset.iterations):
        optimiser.step()
    assert error(limb, optimiser.weights()) < 0.4 * error(limb, start)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("grid", {}, "no weight field 'grid'"),
        ("volume", {"size": 3}, "no option size"),
        ("volume", {"resolution": 100}, "resolution is 100"),
        ("volume", {"width": 2}, "width is 2"),
        ("volume", {"start": "zero"}, "start is 'zero'"),
        ("volume", {"fit_steps": 0}, "fit_steps is 0"),
        ("pyramid", {"resolutions": [1]}, "resolutions"),
    ],
)
def test_bad_choices_are_named(name, options, words):
    with pytest.raises(InputError, match=words):
        create_field(name, np.eye(3), np.eye(3), options)


def test_every_field_can_be_made():
    limb = make_limb(60)
    options = {"volume": {"resolution": 8, "width": 16}}
    for name in WEIGHT_FIELDS:
        field = create_field(name, limb.cloud.means, limb.weights, options.get(name))
        assert field().shape == limb.weights.shape
