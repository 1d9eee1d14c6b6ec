# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the networks that find joints: numpy and torch agree, and a few steps learn what a body teaches."""

from __future__ import annotations

import capsule_person as persons
import numpy as np
import torch

from gskin_addon.core.skeleton.body_shape import body_shape
from gskin_addon.core.skeleton.joints import HUMAN, both_sides
from gskin_addon.core.skeleton.stance import quarter_turns, stand
from gskin_addon.core.skeleton.votes import VoteNetwork, features, mirrored
from gskin_addon.core.training.skeleton.examples import Example, turn_between
from gskin_addon.core.training.skeleton.train import side_columns, train, turned_by_quarters
from gskin_addon.core.training.skeleton.vote_module import VoteModule


def example(seed: int) -> Example:
    standing = stand(body_shape(persons.person(3000, seed)), "height")
    rng = np.random.default_rng(seed)
    values = features(standing.shape, standing.scale)
    known = persons.joints()
    joints = np.array([(known[name] - standing.origin) / standing.scale for name in both_sides(HUMAN)])
    return Example(values[rng.choice(len(values), 256)], joints, standing.diagonal / standing.scale)


def test_numpy_answers_as_torch_does():
    values = example(0).values
    module = VoteModule(len(HUMAN), 16, values.mean(0), values.std(0) + 1e-3)
    joints, places, weight, fits = module(torch.from_numpy(values)[None])
    votes = VoteNetwork({name: value.detach().numpy() for name, value in module.state_dict().items()})(values)
    np.testing.assert_allclose(votes.joints, joints[0].detach().numpy(), atol=1e-4)
    assert abs(votes.fits - fits.item()) < 1e-4
    far = torch.linalg.vector_norm(places - joints[:, None], dim=3)
    np.testing.assert_allclose(votes.spread, (weight * far).sum(1)[0].detach().numpy(), atol=1e-4)


def test_a_few_steps_learn_one_body():
    examples = [example(seed) for seed in range(3)]
    network = VoteNetwork(train(examples, ["a", "a", "b"], HUMAN, steps=150, width=24))
    unseen = example(7)
    left, right = side_columns(HUMAN)
    off = np.linalg.norm(network(unseen.values).joints - unseen.joints[left], axis=1)
    other = np.linalg.norm(network(mirrored(unseen.values)).joints * [-1, 1, 1] - unseen.joints[right], axis=1)
    assert off.mean() < 0.05
    assert other.mean() < 0.05


def test_turned_features_are_those_of_a_turned_body():
    shape = body_shape(persons.person(3000))
    plain = features(*(lambda s: (s.shape, s.scale))(stand(shape, "height")))
    for number, turned in enumerate(quarter_turns(shape)):
        standing = stand(turned, "height")
        expected = features(standing.shape, standing.scale)
        found = turned_by_quarters(plain[None], np.array([number]))[0]
        np.testing.assert_allclose(found[:, :-3], expected[:, :-3], atol=0.02)


def test_the_smallest_turn():
    for goal in ([0, 0, 1], [1, 1, 0], [-1, 0, 0], [1, 0, 0]):
        turn = turn_between(np.array([2.0, 0, 0]), np.array(goal, float))
        np.testing.assert_allclose(turn @ [1, 0, 0], np.array(goal) / np.linalg.norm(goal), atol=1e-12)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
