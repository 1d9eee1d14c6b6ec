# SPDX-License-Identifier: GPL-3.0-or-later
"""The shipped model on creatures that it never saw, and on odd bodies and skeletons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.errors import Cancelled
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.rig.poses import random_axes, random_poses
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.initial import initial_weights_geodesic, initial_with_confidence
from gskin_addon.core.skinning.learned import predict
from gskin_addon.core.skinning.learned.predict import learned_weights
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.training.prior import creatures
from tests.helpers.limb import make_limb


def posed_distance(points, skeleton, weights, truth):
    rng = np.random.default_rng(977)
    poses = pose_transforms(skeleton, random_poses(skeleton, random_axes(16, rng), 16, rng))
    points = points.astype(float)
    return float(
        np.linalg.norm(
            skin_points(points, weights, poses) - skin_points(points, truth, poses), axis=-1
        ).mean()
    )


def check(weights, confidence, cloud, skeleton):
    assert weights.shape == (cloud.count, skeleton.count)
    assert weights.dtype == np.float32
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)
    assert confidence.shape == (cloud.count,)
    assert confidence.min() >= 0
    assert confidence.max() <= 1


def test_better_than_distances_on_creatures_that_were_not_trained():
    """Their seeds are not of the form that `creature_sample` makes."""
    ratios = []
    for seed in (1, 2, 3, 4):
        body = creatures.generate_creature(np.random.default_rng([seed, 20_011]))
        cloud, skeleton = body.cloud, body.skeleton
        weights, confidence = learned_weights(cloud, skeleton)
        check(weights, confidence, cloud, skeleton)
        plain = initial_weights_geodesic(
            cloud.means, cloud.opacities, skeleton, scales=cloud.scales, quats=cloud.quats
        )
        errors = [posed_distance(cloud.means, skeleton, w, body.weights) for w in (weights, plain)]
        ratios.append(errors[0] / errors[1])
        wrong = np.abs(weights - body.weights).sum(axis=1) / 2
        low, high = np.quantile(confidence, [0.2, 0.8])
        assert wrong[confidence <= low].mean() > wrong[confidence >= high].mean()
    assert max(ratios) < 1
    assert np.mean(ratios) < 0.75


def test_equal_runs_give_equal_bits_wherever_the_body_is():
    limb = make_limb(1500)
    here, confidence_out = learned_weights(limb.cloud, limb.skeleton)
    again, _ = learned_weights(limb.cloud, limb.skeleton)
    np.testing.assert_array_equal(here, again)
    far = replace(limb.cloud, means=limb.cloud.means * 50 + 7, scales=limb.cloud.scales * 50)
    there, _ = learned_weights(far, limb.skeleton.moved(np.eye(3), 50.0, (7, 7, 7)))
    assert np.abs(here - there).sum(axis=1).mean() < 0.05
    assert np.abs(here - limb.weights).sum(axis=1).mean() / 2 < 0.15
    assert confidence_out.mean() > 0.5


def test_one_bone_takes_all():
    limb = make_limb(600, bones=1)
    weights, confidence = learned_weights(limb.cloud, limb.skeleton)
    check(weights, confidence, limb.cloud, limb.skeleton)
    np.testing.assert_allclose(weights, 1)


def test_a_hundred_and_fifty_bones():
    limb = make_limb(3000, bones=6)
    count = 150
    heads = np.column_stack([np.linspace(0, 6, count, endpoint=False), np.zeros((count, 2))])
    skeleton = Skeleton(tuple(map(str, range(count))), np.arange(count) - 1, heads, heads + [6 / count, 0, 0])
    weights, confidence = learned_weights(limb.cloud, skeleton)
    check(weights, confidence, limb.cloud, skeleton)
    middle = weights @ (heads[:, 0] + 3 / count)
    assert np.abs(middle - limb.cloud.means[:, 0]).mean() < 0.15


def test_pieces_that_do_not_touch_follow_their_own_bones():
    limb = make_limb(1200, bones=2)
    other = replace(limb.cloud, means=limb.cloud.means + np.float32([0, 0, 2]))
    names = ("means", "quats", "scales", "opacities", "sh")
    both = SplatCloud(**{n: np.concatenate([getattr(limb.cloud, n), getattr(other, n)]) for n in names})
    lower = limb.skeleton
    skeleton = Skeleton(
        ("a", "b", "c", "d"), np.array([-1, 0, -1, 2]), np.concatenate([lower.heads, lower.heads + [0, 0, 2]]),
        np.concatenate([lower.tails, lower.tails + [0, 0, 2]]),
    )  # fmt: skip
    weights, confidence = learned_weights(both, skeleton)
    check(weights, confidence, both, skeleton)
    assert weights[:1200, 2:].sum(axis=1).mean() < 0.05
    assert weights[1200:, :2].sum(axis=1).mean() < 0.05


def test_splats_between_the_nodes_follow_them(monkeypatch):
    limb = make_limb(4000)
    every, _ = learned_weights(limb.cloud, limb.skeleton)
    monkeypatch.setattr(predict, "NODES", 1000)
    spread, confidence = learned_weights(limb.cloud, limb.skeleton)
    check(spread, confidence, limb.cloud, limb.skeleton)
    assert np.abs(every - spread).sum(axis=1).mean() / 2 < 0.08


def test_two_splats_are_a_body():
    limb = make_limb(600)
    pair = limb.cloud.select(np.array([5, 400]))
    check(*learned_weights(pair, limb.skeleton), pair, limb.skeleton)


@pytest.mark.parametrize("name", ["learned", "heat", "geodesic"])
def test_the_work_tells_how_far_it_is_and_can_be_stopped(name):
    limb = make_limb(8000)
    told: list[float] = []

    def weights(tick):
        return initial_with_confidence(name, limb.cloud, limb.skeleton, np.zeros((0, 4, 4), bool), [], tick=tick)[0]

    np.testing.assert_array_equal(weights(told.append), weights(lambda done: None))
    assert told == sorted(told)
    assert min(told) >= 0
    assert max(told) <= 1
    for stop in (0.0, 0.3, 0.7):

        def tick(done, stop=stop):
            if done >= stop:
                raise Cancelled

        with pytest.raises(Cancelled):
            weights(tick)


@pytest.mark.parametrize("name", ["learned"])
def test_the_registry_gives_the_same(name):
    from gskin_addon.core.skinning.initial import initial_weights

    limb = make_limb(500)
    weights, _ = learned_weights(limb.cloud, limb.skeleton)
    empty = np.zeros((0, 4, 4), bool)
    np.testing.assert_array_equal(initial_weights(name, limb.cloud, limb.skeleton, empty, []), weights)
