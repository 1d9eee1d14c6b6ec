# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights on both sides of a seam: each follows its own bones alone."""

from __future__ import annotations

import numpy as np

from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.edits.keep_apart import keep_apart
from gskin_addon.core.skinning.edits.separate import separate

NAMES = ("hips", "thigh", "spine", "arm", "hand")
PARENTS = np.array([-1, 0, 0, 2, 3])
HEADS = np.array([[0, 0, 1.0], [0, 0, 1.0], [0, 0, 1.4], [0.5, 0, 1.4], [0.5, 0, 0.8]])
TAILS = np.array([[0, 0, 1.4], [0, 0, 0.0], [0.5, 0, 1.4], [0.5, 0, 0.8], [0.35, 0, 0.5]])
SKELETON = Skeleton(NAMES, PARENTS, HEADS, TAILS)


def tube(start, end, radius, count, rng):
    start, end = np.asarray(start, float), np.asarray(end, float)
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0, 1.0, 0])
    turn, height = rng.random(count) * 2 * np.pi, rng.random((count, 1))
    ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    return start + height * (end - start) + radius * ring


def held_against_a_thigh():
    """A thigh, an arm whose hand holds a ball, and the ball, which touches the thigh: there the weights are wrong."""
    rng = np.random.default_rng(3)
    thigh = tube((0, 0, 1.4), (0, 0, 0), 0.15, 4000, rng)
    arm = tube((0.5, 0, 1.4), (0.5, 0, 0.75), 0.06, 1200, rng)
    ball = rng.normal(size=(2500, 3))
    ball = ball / np.linalg.norm(ball, axis=1, keepdims=True) * 0.17 + [0.33, 0, 0.6]
    means = np.concatenate([thigh, arm, ball])
    part = np.repeat([0, 1, 2], [len(thigh), len(arm), len(ball)])
    weights = np.zeros((len(means), 5), np.float32)
    weights[part == 0, 1] = 1
    weights[part == 1, 3] = 1
    weights[part == 2] = [0, 0.1, 0, 0, 0.9]
    touching = (part == 0) & (np.linalg.norm(means - [0.33, 0, 0.6], axis=1) < 0.24)
    weights[touching] = [0, 0.05, 0, 0, 0.95]
    assert touching.sum() > 100
    return means, weights, part, touching


def test_what_a_wrong_weight_says_is_not_what_a_splat_belongs_to():
    means, weights, part, touching = held_against_a_thigh()
    labels = separate(means, weights, SKELETON, part == 2)
    assert (labels[part == 2] == 1).all()
    assert (labels[part == 1] == 0).all(), "the arm holds the ball"
    assert (labels[touching] == 2).mean() > 0.99
    assert (labels[part == 0] != 1).all()


def test_neither_side_follows_the_other():
    means, weights, part, touching = held_against_a_thigh()
    labels = separate(means, weights, SKELETON, part == 2)
    after, changed = keep_apart(weights, means, labels, SKELETON)
    seam = touching & (labels == 2)
    assert (after[seam, 1] > 0.99).all(), "as the thigh around them"
    assert (after[part == 2, 4] > 0.99).all()
    np.testing.assert_allclose(after.sum(axis=1), 1, atol=1e-5)
    assert np.array_equal(after[~changed], weights[~changed])
    assert not changed[part == 1].any()
    again, more = keep_apart(after, means, labels, SKELETON)
    assert np.array_equal(again, after)
    assert not more.any()


def test_a_part_that_follows_the_wrong_bone_is_told_its_own():
    means, weights, part, _ = held_against_a_thigh()
    weights[part == 2] = [0, 1, 0, 0, 0]
    hand = (part == 1) & (means[:, 2] < 0.85)
    weights[hand] = [0, 0, 0, 0.5, 0.5]
    labels = separate(means, weights, SKELETON, part == 2, bone=4)
    after, _ = keep_apart(weights, means, labels, SKELETON, bones={1: 4})
    assert after[part == 2, 1].max() == 0
    np.testing.assert_allclose(after[part == 2][:, [3, 4]], 0.5, atol=0.05)


def test_the_other_sides_of_two_seams_are_one():
    means, weights, part, _ = held_against_a_thigh()
    upper = part == 2
    upper &= means[:, 2] > 0.6
    first = separate(means, weights, SKELETON, upper)
    both = separate(means, weights, SKELETON, (part == 2) & ~upper, sides=first)
    assert set(np.unique(both)) == {0, 1, 3, 4}
    assert (both[upper] == 1).all()
    assert (both[first == 2] == 4).all()
