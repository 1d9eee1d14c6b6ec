# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.oracle import Oracle
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.rig.lbs import skin_cloud
from gskin_addon.core.skinning.views import GuidanceViews, Target
from tests.helpers.limb import make_limb


@pytest.fixture(scope="module")
def scene():
    limb = make_limb(4000)
    cameras = paper_views(*limb.cloud.bounds(), 128)
    signals = make_signals(limb.skeleton, cameras[:2], 3, np.random.default_rng(0))
    context = GuidanceContext(limb.cloud, limb.skeleton, limb.weights, limb.weights)
    images = Oracle(context, limb.weights).images(signals)
    targets = [Target(s.camera, s.transforms, image) for s, image in zip(signals, images, strict=True)]
    return limb, targets


def posed(limb, weights):
    def pose(transforms):
        clouds = [skin_cloud(limb.cloud, weights, t, rotate_sh=False) for t in transforms]
        return np.stack([c.means for c in clouds]), np.stack([c.quats for c in clouds])

    return pose


def views_of(limb, targets, cloud=None):
    return GuidanceViews(cloud or limb.cloud, targets, dssim=0.2, background=(1.0, 1.0, 1.0))


def test_the_far_side_is_left_out_and_the_loss_hardly_changes(scene):
    limb, targets = scene
    start = np.full_like(limb.weights, 1 / 3)
    pose = posed(limb, start)
    views = views_of(limb, targets)
    means, quats = pose(np.stack([t.transforms for t in targets]))
    batch = list(range(len(targets)))
    value, grad_means, _ = views.render_and_grad(means, quats, batch, 128)
    views.update_visible(pose, 128)
    front, back = views.visible
    assert 0.3 < front.mean() < 0.8
    # Cameras in front and behind: each splat of a tube shows to one of them, few to both.
    assert (front | back).mean() > 0.85
    assert (front & back).mean() < 0.5
    pruned, grads, _ = views.render_and_grad(means, quats, batch, 128)
    assert pruned == pytest.approx(value, rel=0.02)
    assert not grads[0][~front].any()
    visible = grad_means[0][front]
    assert np.linalg.norm(grads[0][front] - visible) < 0.2 * np.linalg.norm(visible)


def test_small_renders_and_colours_by_view_are_pruned_too(scene):
    limb, targets = scene
    sh = np.concatenate([limb.cloud.sh, np.zeros((4000, 3, 3), np.float32)], axis=1)
    sh[:, 1] = 0.2
    views = views_of(limb, targets, replace(limb.cloud, sh=sh))
    pose = posed(limb, limb.weights)
    views.update_visible(pose, 64)
    means, quats = pose(np.stack([targets[0].transforms, targets[4].transforms]))
    value, grad, _ = views.render_and_grad(means, quats, [0, 4], 64)
    assert np.isfinite(value)
    assert not grad[1][~views.visible[1]].any()
    assert views.loss(means[0], quats[0], 0, 128) < 0.1
