# SPDX-License-Identifier: GPL-3.0-or-later
"""Seams: which splats get which label, and that weights no longer cross."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.edits.separate import separate, steps_between
from gskin_addon.core.skinning.walls import blocked


def test_steps_are_those_of_a_search():
    parents = np.array([-1, 0, 1, 1, 0, -1, 5])
    expected = np.full((7, 7), 7)
    for start in range(7):
        expected[start, start] = 0
        for _ in range(7):
            for bone, parent in enumerate(parents):
                if parent >= 0:
                    expected[start, bone] = min(expected[start, bone], expected[start, parent] + 1)
                    expected[start, parent] = min(expected[start, parent], expected[start, bone] + 1)
    assert np.array_equal(steps_between(parents), expected)


def body():
    """A leg along z, and a hand with a ball that touches it; bones hips, thigh, chest, arm, hand."""
    rng = np.random.default_rng(0)
    leg = rng.random((400, 3)) * [0.2, 0.2, 1.0]
    ball = rng.random((150, 3)) * 0.2 + [0.2, 0, 0.4]
    hand = rng.random((100, 3)) * 0.2 + [0.4, 0, 0.4]
    means = np.concatenate([leg, ball, hand])
    names = ("hips", "thigh", "chest", "arm", "hand")
    heads = np.array([[0, 0, 1.1], [0.1, 0.1, 1], [0, 0, 1.3], [0.4, 0, 1.3], [0.5, 0.1, 0.6]])
    tails = np.array([[0, 0, 1.3], [0.1, 0.1, 0], [0, 0, 1.5], [0.5, 0, 0.6], [0.5, 0.1, 0.4]])
    skeleton = Skeleton(names, np.array([-1, 0, 0, 2, 3]), heads, tails)
    weights = np.zeros((650, 5), np.float32)
    weights[:400, 1] = 1
    weights[400:550] = [0, 0.45, 0, 0, 0.55]
    weights[550:, 4] = 1
    return means, weights, skeleton, np.arange(650)


def test_what_holds_the_selection_stays_open_and_what_it_touches_does_not():
    means, weights, skeleton, number = body()
    ball, leg, hand = (number >= 400) & (number < 550), number < 400, number >= 550
    labels = separate(means, weights, skeleton, ball, 0.05)
    assert (labels[ball] == 1).all()
    assert (labels[hand] == 0).all()
    way = np.linalg.norm(means[:, None] - means[ball][None], axis=2).min(axis=1)
    touching = leg & (way <= 0.05)
    assert np.array_equal(labels == 2, touching)
    assert touching.any()
    assert blocked(labels[ball][:, None], labels[touching][None]).all()


def test_a_second_seam_leaves_the_first():
    means, weights, skeleton, number = body()
    first = separate(means, weights, skeleton, (number >= 400) & (number < 550), 0.05)
    both = separate(means, weights, skeleton, number >= 550, 0.25, sides=first)
    assert (both[number >= 550] == 3).all()
    assert (both[(number >= 400) & (number < 550)] == 1).all()
    assert set(np.unique(both[number < 400])) <= {0, 2, 4}


def test_the_bone_may_be_named_and_nothing_foreign_is_refused():
    means, weights, skeleton, number = body()
    wrong = weights.copy()
    wrong[400:550] = [0, 1, 0, 0, 0]  # the ball follows the thigh altogether
    ball = (number >= 400) & (number < 550)
    with pytest.raises(InputError, match="'thigh'"):
        separate(means[number < 550], wrong[number < 550], skeleton, ball[number < 550], 0.05)
    labels = separate(means, wrong, skeleton, ball, 0.05, bone=4)
    assert (labels[number < 400] == 2).any()
    assert (labels[number >= 550] == 0).all()
