# SPDX-License-Identifier: GPL-3.0-or-later
"""Bodies of other proportions: against the kinematics of poses, and by what must stay together."""

from __future__ import annotations

import numpy as np

from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.quaternion import axis_angle_to_matrix
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.training.prior.proportions import change_proportions, proportion_transforms
from gskin_addon.core.training.rigged import RiggedMesh

ARM = Skeleton(
    ("upper", "fore", "hand", "other"), np.array([-1, 0, 1, 0]),
    np.array([[0, 0, 0], [2, 0, 0], [3, 0, 0.5], [2, 0, 0]]),
    np.array([[2, 0, 0], [3, 0, 0.5], [3.5, 0, 0.5], [2, 1.0, 0]]),
)  # fmt: skip
STRAIGHT = np.broadcast_to(np.eye(3), (4, 3, 3))


def test_turns_alone_are_a_pose():
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(4, 3))
    turns = axis_angle_to_matrix(axes / np.linalg.norm(axes, axis=1, keepdims=True), rng.uniform(-2, 2, 4))
    got = proportion_transforms(ARM, np.ones(4), np.ones(4), turns)
    np.testing.assert_allclose(got, pose_transforms(ARM, turns)[:, :3], atol=1e-12)


def test_a_longer_bone_carries_the_next_one_away_and_does_not_stretch_it():
    stretch = np.array([1.5, 1, 1, 1.0])
    upper, fore, *_ = proportion_transforms(ARM, stretch, np.ones(4), STRAIGHT)
    np.testing.assert_allclose(upper @ [2, 0, 0, 1], [3, 0, 0])
    np.testing.assert_allclose(upper @ [1, 0.2, 0.1, 1], [1.5, 0.2, 0.1])  # along, not across
    np.testing.assert_allclose(fore @ [2, 0, 0, 1], [3, 0, 0])  # the joint holds
    np.testing.assert_allclose(fore[:, :3], np.eye(3))


def test_a_thicker_bone_keeps_its_length_and_its_joints():
    wide = proportion_transforms(ARM, np.ones(4), np.array([1, 2, 1, 1.0]), STRAIGHT)
    for point in ([2, 0, 0, 1], [3, 0, 0.5, 1]):
        np.testing.assert_allclose(wide[1] @ point, point[:3], atol=1e-12)
    np.testing.assert_allclose(wide[1] @ [2.5, 0.3, 0.25, 1], [2.5, 0.6, 0.25], atol=1e-12)


def test_reshaped_flesh_follows_its_bones_and_keeps_its_weights():
    rng = np.random.default_rng(3)
    bone = np.repeat(np.arange(4), 30)
    along = rng.uniform(0, 1, 120)
    verts = ARM.heads[bone] + along[:, None] * (ARM.tails - ARM.heads)[bone]  # on the bones
    loose = np.array([[9.0, 9, 9]])
    weights = np.concatenate([np.eye(4, dtype=np.float32)[bone], np.zeros((1, 4), np.float32)])
    mesh = RiggedMesh(
        np.concatenate([verts, loose]), np.zeros((0, 3), int), np.zeros((0, 3, 3)), weights, ARM, np.ones(4, bool)
    )
    shapes = [change_proportions(mesh, np.random.default_rng(seed)) for seed in range(5)]
    for shape in shapes:
        new = shape.skeleton
        wanted = new.heads[bone] + along[:, None] * (new.tails - new.heads)[bone]
        np.testing.assert_allclose(shape.verts[:-1], wanted, atol=1e-6)
        np.testing.assert_allclose(shape.verts[-1:], loose)  # nothing holds it, nothing moves it
        np.testing.assert_allclose(new.heads[[1, 3]], new.tails[[0, 0]], atol=1e-6)
        assert shape.weights is mesh.weights
    lengths = np.stack([shape.skeleton.lengths for shape in shapes])
    assert (np.ptp(lengths / ARM.lengths, axis=0) > 0.05).all()  # they do differ
