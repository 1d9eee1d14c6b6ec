# SPDX-License-Identifier: GPL-3.0-or-later
"""Eq. 8 to 11 with the settings of the preset `paper`, as one iteration computes them, against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.oracle import Oracle
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.job.settings import JobSettings
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.render.image_metrics import ssim
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.lbs import skin_cloud
from gskin_addon.core.skinning.fields.pyramid import SparsePyramid
from gskin_addon.core.skinning.fields.volume import WeightVolume
from gskin_addon.core.skinning.losses import LossWeights
from gskin_addon.core.skinning.optimise import LearningOptions, Optimiser, Target
from gskin_addon.core.skinning.presets import Preset
from tests.helpers.limb import make_limb

PAPER = LossWeights.parse(JobSettings.parse({"preset": "paper"}).losses)
ONE_STEP = Preset("one step on all images", 1, ((96, 1),), 4, prune=False)


@pytest.fixture(scope="module")
def scene():
    limb = make_limb(150)
    start = 0.6 * limb.weights + 0.4 / 3
    cameras = paper_views(*limb.cloud.bounds(), 96)
    signals = make_signals(limb.skeleton, cameras, 1, np.random.default_rng(0))
    images = Oracle(GuidanceContext(limb.cloud, limb.skeleton, start, start), limb.weights).images(signals)
    return limb, start, [Target(s.camera, s.transforms, image) for s, image in zip(signals, images, strict=True)]


def optimiser(scene, losses):
    limb, start, targets = scene
    field = SparsePyramid(limb.cloud.means, start)
    options = LearningOptions(losses=losses, prune=False, rasterizer="cpu")
    return Optimiser(limb.cloud, limb.skeleton, field, targets, ONE_STEP, options=options)


def posed(scene, weights):
    """Eq. 1, splat by splat and bone by bone: (P, N, 3)."""
    limb, _, targets = scene
    out = np.zeros((len(targets), limb.cloud.count, 3))
    for p, target in enumerate(targets):
        for n, x in enumerate(limb.cloud.means.astype(np.float64)):
            for b, matrix in enumerate(target.transforms):
                out[p, n] += weights[n, b] * (matrix @ [*x, 1.0])[:3]
    return out


def arap(rest, moved, neighbours):
    """Eq. 10 over all splats and their nearest neighbours, divided by the mean squared edge."""
    total, edges, square = 0.0, 0, 0.0
    for after in moved:
        for j, x in enumerate(rest):
            near = np.argsort(np.linalg.norm(rest - x, axis=1), kind="stable")
            near = near[near != j][:neighbours]
            before, now = rest[near] - x, after[near] - after[j]
            rotation = Rotation.align_vectors(now, before)[0].as_matrix()
            total += np.square(now - before @ rotation.T).sum()
            square += np.square(before).sum()
            edges += len(near)
    return total / (2 * edges) / (square / edges)


def coupling(scene, moved):
    """Eq. 11: points inside the bones, from joint to joint, and the eight splats nearest to each."""
    limb, _, targets = scene
    rest, skeleton = limb.cloud.means.astype(np.float64), limb.skeleton
    changes = []
    for target, after in zip(targets, moved, strict=True):
        for bone in range(skeleton.count):
            for part in (np.arange(8) + 0.5) / 8:
                u = skeleton.heads[bone] + part * (skeleton.tails[bone] - skeleton.heads[bone])
                now = (target.transforms[bone] @ [*u, 1.0])[:3]
                for k in np.argsort(np.linalg.norm(rest - u, axis=1))[:8]:
                    changes.append((np.linalg.norm(u - rest[k]) - np.linalg.norm(now - after[k])) ** 2)
    return np.mean(changes)


def rendering(scene, weights):
    """L1 and D-SSIM between renders and guidance images."""
    limb, _, targets = scene
    values = []
    for target in targets:
        image = render_cloud(skin_cloud(limb.cloud, weights, target.transforms), target.camera)[0]
        truth = target.image.astype(np.float64) / 255
        values.append(0.8 * np.abs(image - truth).mean() + 0.2 * (1 - ssim(image, truth.astype(np.float32))))
    return np.mean(values)


def test_the_parts_of_equation_9_are_their_formulas(scene):
    learning = optimiser(scene, PAPER)
    weights = learning.weights().astype(np.float64)
    parts = learning.step()
    assert set(parts) == {"render", "arap", "coupling"}
    moved = posed(scene, weights)
    assert parts["arap"] == pytest.approx(arap(scene[0].cloud.means.astype(np.float64), moved, 30), rel=1e-3)
    assert parts["coupling"] == pytest.approx(coupling(scene, moved), rel=1e-3)
    assert parts["render"] == pytest.approx(rendering(scene, weights), rel=2e-3)


def test_equation_9_is_their_weighted_sum(scene):
    """The gradient of the whole is w_a and w_c times those of the parts, and that of the images."""
    whole = {"arap": 0.3, "coupling": 7.0, "anchor": 0.0, "arap_nodes": 0, "arap_neighbours": 30}
    gradients = []
    for chosen in (whole, {**whole, "arap": 0, "coupling": 0}, {**whole, "coupling": 0}, {**whole, "arap": 0}):
        learning = optimiser(scene, LossWeights.parse(chosen))
        learning.try_out(96)
        gradients.append(torch.cat([p.grad.ravel() for p in learning.field.parameters()]).numpy())
    total, images, rigid, coupled = gradients
    np.testing.assert_allclose(total, rigid + coupled - images, atol=1e-4 * np.abs(total).max())
    double = optimiser(scene, LossWeights.parse({**whole, "arap": 0.6, "coupling": 0}))
    double.try_out(96)
    gradient = torch.cat([p.grad.ravel() for p in double.field.parameters()]).numpy()
    np.testing.assert_allclose(gradient - images, 2 * (rigid - images), atol=1e-4 * np.abs(gradient).max())
    assert np.abs(rigid - images).max() > 1e-3 * np.abs(images).max()


def test_equation_8_is_what_the_fit_descends():
    """One step of Adam on the summed squares of a splat's weights, averaged over splats."""
    limb = make_limb(40)
    start = 0.6 * limb.weights + 0.4 / 3
    fields = [WeightVolume(limb.cloud.means, start, 8, 16, start="fit", fit_steps=1) for _ in range(2)]
    fields[0].fit()
    by_hand = fields[1]
    adam = torch.optim.Adam(by_hand.parameters(), lr=2e-3)
    wanted = torch.as_tensor(start, dtype=torch.float32)
    loss = sum((by_hand()[n, b] - wanted[n, b]) ** 2 for n in range(40) for b in range(3)) / 40
    loss.backward()
    adam.step()
    for one, other in zip(fields[0].parameters(), by_hand.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    assert float((fields[0]().detach() - wanted).square().sum()) < 40 * float(loss.detach())
