# SPDX-License-Identifier: GPL-3.0-or-later
"""Training: the loss against plain arithmetic, one creature learned by heart, stopping and going on."""

from __future__ import annotations

import signal

import numpy as np
import pytest
import torch
from patience import interrupts

from gskin_addon.core.checkpoint import load_checkpoint
from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.bone_roles import ROLES, bone_roles
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.training.prior import creatures, rig_changes
from gskin_addon.core.training.prior.capsules import RigBuilder, cover_with_splats
from gskin_addon.core.training.prior.samples import TrainingSample, make_sample, random_sample_poses
from gskin_addon.core.training.prior.sampling_plan import SamplingPlan
from gskin_addon.core.training.prior.torch_network import make_batch
from gskin_addon.core.training.prior.train import (
    ALL_NAMES_DROPOUT,
    NAME_DROPOUT,
    Schedule,
    Trainer,
    posed_error,
)


@pytest.fixture(scope="module")
def sampling_plan(tmp_path_factory):
    """One creature, one sample."""
    rng = np.random.default_rng(11)
    path = tmp_path_factory.mktemp("samples") / "one.npz"
    make_sample(creatures.generate_creature(rng), rng, rows=100).save(path)
    return SamplingPlan({"made up": {"one": [path]}})


def only_sample(sampling_plan):
    return sampling_plan.draw(1, np.random.default_rng(0))[0]


def test_samples_come_back_from_disk(sampling_plan, tmp_path):
    sample = only_sample(sampling_plan)
    sample.save(tmp_path / "again.npz")
    again = TrainingSample.load(tmp_path / "again.npz")
    for name, value in vars(sample).items():
        np.testing.assert_array_equal(value, getattr(again, name))
    assert sample.difficulty > 0
    np.testing.assert_allclose(sample.truth.astype(float).sum(axis=1), 1, atol=5e-3)


def test_posed_error_is_the_distance_to_the_true_place(sampling_plan):
    sample = only_sample(sampling_plan)
    rng = np.random.default_rng(1)
    poses = random_sample_poses(sample, 3, rng)
    share = rng.dirichlet(np.ones(sample.bone.shape[1]), len(sample.bone))
    share = np.where(sample.bone >= 0, share, 0)
    dense = np.zeros(sample.truth.shape)
    rows, tokens = np.nonzero(sample.bone >= 0)
    dense[rows, sample.bone[rows, tokens]] = share[rows, tokens]
    truth = sample.truth.astype(float)
    expected = [skin_points(sample.points.astype(float), w, poses) for w in (dense, truth)]
    got = posed_error(
        torch.from_numpy(share.astype(np.float32)), torch.from_numpy(truth.astype(np.float32)),
        torch.from_numpy(sample.bone.astype(np.int64)).clamp(min=0), sample, poses,
    )  # fmt: skip
    np.testing.assert_allclose(got, 100 * np.linalg.norm(expected[0] - expected[1], axis=-1), atol=1e-2)


def test_one_creature_is_learned_by_heart(sampling_plan):
    sample = only_sample(sampling_plan)
    trainer = Trainer(sampling_plan, Schedule(steps=70, samples=1, rate=5e-3, average=0.9))
    for _ in range(70):
        trainer.step()
    with torch.no_grad():
        answer = trainer.result()(make_batch([vars(sample)]))
        error = posed_error(
            answer.final.softmax(-1), torch.from_numpy(sample.truth.astype(np.float32)),
            torch.from_numpy(sample.bone.astype(np.int64)).clamp(min=0), sample,
            random_sample_poses(sample, 16, np.random.default_rng(0)),
        )  # fmt: skip
    assert float(error.mean()) < 0.5 * sample.difficulty


def test_a_stopped_training_goes_on_and_ends_the_same(sampling_plan, tmp_path):
    schedule = Schedule(steps=6, samples=1)
    whole, first, second = (Trainer(sampling_plan, schedule) for _ in range(3))
    for _ in range(6):
        whole.step()
    for _ in range(3):
        first.step()
    first.save(tmp_path / "state")
    # The key is older than the field's name: a training that an earlier version began goes on.
    assert load_checkpoint(tmp_path / "state")["schedule"]["lessons"] == 1
    second.restore(tmp_path / "state")
    for _ in range(3):
        second.step()
    assert second.step_number == 6
    for a, b in zip(whole.result().state_dict().values(), second.result().state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    with pytest.raises(InputError, match="other settings"):
        Trainer(sampling_plan, Schedule(steps=7)).restore(tmp_path / "state")


def test_changed_skeletons_keep_the_weights_whole():
    rng = np.random.default_rng(3)
    body = creatures.generate_creature(rng)
    points, skeleton, weights = body.cloud.means.astype(float), body.skeleton, body.weights
    size = 2.0
    split, shared = rig_changes.split_bones(skeleton, weights, points, rng, 3, size)
    assert split.count > skeleton.count
    dropped, fewer = rig_changes.drop_bones(skeleton, weights, rng, 3)
    assert dropped.count == skeleton.count - 3
    idle, padded = rig_changes.add_idle_bones(skeleton, weights, rng, 4, size)
    assert padded[:, skeleton.count :].max() == 0
    moved = rig_changes.move_joints(skeleton, rng, 0.1, size)
    assert np.linalg.norm(moved.heads - skeleton.heads, axis=1).max() <= 0.1 + 1e-9
    stubs = rig_changes.replace_tails(skeleton, rng, size)
    for changed, after in (
        (split, shared),
        (dropped, fewer),
        (idle, padded),
        (moved, weights),
        (stubs, weights),
    ):
        changed.validate()
        assert after.shape[1] == changed.count
        np.testing.assert_allclose(after.sum(axis=1), 1, atol=1e-5)


def test_changed_skeletons_keep_what_bones_are_for():
    rng = np.random.default_rng(4)
    body = creatures.generate_creature(rng, creatures.KINDS[0][0])  # a biped
    points, skeleton, weights = body.cloud.means.astype(float), body.skeleton, body.weights
    roles = bone_roles(skeleton.names)
    assert {"head", "upper leg", "hand"} <= {ROLES[role] for role in roles}
    split, shared = rig_changes.split_bones(skeleton, weights, points, rng, 4, 2.0)
    for role in np.unique(roles):  # a bone's halves do what it did, and carry what it carried
        before = weights[:, roles == role].sum(axis=1)
        np.testing.assert_allclose(shared[:, bone_roles(split.names) == role].sum(axis=1), before, atol=1e-5)
    idle, _ = rig_changes.add_idle_bones(skeleton, weights, rng, 40, 2.0)
    np.testing.assert_array_equal(bone_roles(idle.names)[: skeleton.count], roles)
    assert {ROLES[role] for role in bone_roles(idle.names)[skeleton.count :]} == {"helper", "unknown"}
    np.testing.assert_array_equal(bone_roles(rig_changes.move_joints(skeleton, rng, 0.1, 2.0).names), roles)


def test_buried_bones_start_deeper_in_the_flesh_of_their_parent():
    """A wing on a trunk moves towards the trunk's axis, by one share for all; a bone as thick as its parent stays."""
    rig = RigBuilder(np.random.default_rng(0))
    trunk = rig.add_bone(-1, np.array([0, 0, 0.0]), np.array([0, 0, 1.0]))
    rig.add_capsule(trunk, 0.5, 0.5, np.ones(3))
    neck = rig.add_chain(trunk, np.array([0, 0, 1.0]), np.array([0, 0, 1.0]), np.ones(1), 0.5, 1.0, np.ones(3))[0]
    side, out = np.array([0.5, 0, 0.6]), np.array([1.0, 0, 0])
    rig.add_mirrored(lambda: rig.add_chain(trunk, side, out, np.ones(2), 0.1, 1.0, np.ones(3)))
    skeleton = Skeleton(tuple("abcdef"), np.array(rig.parents), np.array(rig.heads), np.array(rig.tails))
    shares = []
    for seed in range(60):
        buried = creatures.bury_limb_roots(skeleton, rig, np.random.default_rng(seed))
        np.testing.assert_array_equal(buried.tails, skeleton.tails)
        wings = [2, 4]
        np.testing.assert_array_equal(np.delete(buried.heads, wings, 0), np.delete(skeleton.heads, wings, 0))
        np.testing.assert_allclose(buried.heads[wings, 1:], [[0, 0.6]] * 2)
        np.testing.assert_allclose(buried.heads[2, 0], -buried.heads[4, 0])
        shares.append(1 - buried.heads[2, 0] / 0.5)
    moved = np.array(shares) > 0
    assert neck == 1
    assert moved.mean() == pytest.approx(creatures.BURIED_ROOTS, abs=0.2)
    assert 0.2 <= np.array(shares)[moved].min() < np.array(shares)[moved].max() <= 1


def test_names_are_hidden_in_some_samples(sampling_plan):
    sample = only_sample(sampling_plan)
    trainer = Trainer(sampling_plan, Schedule(steps=1))
    known = make_batch([vars(sample)]).role
    assert known.max() > 0
    left = []
    for seed in range(200):
        role = known.clone()
        trainer._hide_names(role, sample, np.random.default_rng(seed))
        assert ((role == known) | (role == 0)).all()
        left.append(float((role > 0).sum() / (known > 0).sum()))
    nameless = np.array(left) == 0
    assert nameless.mean() == pytest.approx(ALL_NAMES_DROPOUT, abs=0.1)
    assert np.mean(np.array(left)[~nameless]) == pytest.approx(1 - NAME_DROPOUT, abs=0.05)


@pytest.mark.parametrize("grow", [grow for grow, _ in creatures.KINDS])
def test_creatures_differ_and_are_whole(grow):
    sizes = set()
    for seed in range(4):
        body = creatures.generate_creature(np.random.default_rng(seed), grow)
        body.skeleton.validate()
        assert 2000 < body.cloud.count < 6000
        np.testing.assert_allclose(body.weights.sum(axis=1), 1, atol=1e-5)
        assert (body.weights.max(axis=0) > 0.5).sum() >= min(2, body.skeleton.count)
        sizes.add((body.skeleton.count, body.cloud.count))
    assert len(sizes) == 4


def test_what_drapes_follows_its_bone_above_and_the_nearest_below():
    """A skirt of one hip and two legs: all hip at the waist, half of it the own side's leg at the hem."""
    rig = RigBuilder(np.random.default_rng(0))
    hip = rig.add_bone(-1, np.array([0, 0, 1.0]), np.array([0, 0, 1.2]))
    legs = [rig.add_bone(hip, np.array([x, 0, 1.0]), np.array([x, 0, 0.0])) for x in (-0.2, 0.2)]
    span = (np.array([0, 0, 1.0]), np.array([0, 0, 0.2]))
    rig.add_capsule(hip, 0.3, 0.5, np.ones(3), segment=span, drape=tuple(legs), sag=0.5)
    skeleton = Skeleton(("hip", "left", "right"), np.array(rig.parents), np.array(rig.heads), np.array(rig.tails))
    points, _, weights = cover_with_splats(rig, skeleton, 3000)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    high, low, left = points[:, 2] > 1, points[:, 2] < 0.2, points[:, 0] < -0.1
    np.testing.assert_allclose(weights[high, 0], 1)
    np.testing.assert_allclose(weights[low, 0], 0.5)
    assert weights[low & left, 1].min() > weights[low & left, 2].max()


def test_an_interrupt_never_leaves_half_a_step(sampling_plan, monkeypatch):
    """It comes between the two optimisers, waits, and is delivered after the step."""
    trainer = Trainer(sampling_plan, Schedule(steps=4, samples=1))
    first = trainer._optimisers[0][0]
    update = first.step

    def interrupted(*arguments):
        signal.raise_signal(signal.SIGINT)
        return update(*arguments)

    monkeypatch.setattr(first, "step", interrupted)
    with interrupts(), pytest.raises(KeyboardInterrupt):
        trainer.step()
    assert trainer.step_number == len(trainer.losses) == 1
    assert trainer._optimisers[1][0].state
