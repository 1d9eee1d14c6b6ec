# SPDX-License-Identifier: GPL-3.0-or-later
"""Forward kinematics against an independent chain of matrices, and the statistics of random poses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gskin_addon.core.rig.kinematics import joints_posed, pose_transforms
from gskin_addon.core.rig.poses import random_poses, turnable_bones
from gskin_addon.core.rig.skeleton import Skeleton


def random_skeleton(count: int, seed: int = 0, roots: int = 1) -> Skeleton:
    rng = np.random.default_rng(seed)
    parents = np.array([-1] * roots + [int(rng.integers(0, b)) for b in range(roots, count)])
    heads, tails = rng.normal(size=(count, 3)), np.empty((count, 3))
    for b in range(count):
        if parents[b] >= 0:
            heads[b] = tails[parents[b]]
        tails[b] = heads[b] + rng.normal(size=3)
    return Skeleton(tuple(f"b{i}" for i in range(count)), parents, heads, tails)


def _chain(skeleton: Skeleton, bone: int) -> list[int]:
    chain = []
    while bone >= 0:
        chain.append(bone)
        bone = int(skeleton.parents[bone])
    return chain  # from the bone up to its root


def test_equals_turning_about_the_heads_from_the_leaf_up():
    """Independent reading of Eq. 2: a leaf's point is turned by its own bone first, about the rest head, then
    by each ancestor about that ancestor's rest head, and the root's translation comes last."""
    skeleton = random_skeleton(12)
    rotations = Rotation.random(5 * 12, random_state=1).as_matrix().reshape(5, 12, 3, 3)
    shift = np.random.default_rng(2).normal(size=(5, 3))
    transforms = pose_transforms(skeleton, rotations, shift)
    point = np.random.default_rng(3).normal(size=3)
    for pose in range(5):
        for bone in range(12):
            x = point
            for b in _chain(skeleton, bone):
                x = rotations[pose, b] @ (x - skeleton.heads[b]) + skeleton.heads[b]
            got = transforms[pose, bone] @ [*point, 1]
            np.testing.assert_allclose(got, [*(x + shift[pose]), 1], atol=1e-12)


def test_bones_stay_joined_and_keep_their_length():
    skeleton = random_skeleton(20, seed=4)
    rotations = Rotation.random(3 * 20, random_state=2).as_matrix().reshape(3, 20, 3, 3)
    heads, tails = joints_posed(skeleton, pose_transforms(skeleton, rotations))
    assert heads.shape == (3, 20, 3)
    np.testing.assert_allclose(heads[:, 1:], tails[:, skeleton.parents[1:]], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(tails - heads, axis=2), [skeleton.lengths] * 3, atol=1e-12)


def test_identity_pose_one_pose_and_wrong_shape():
    skeleton = random_skeleton(6)
    identity = pose_transforms(skeleton, np.tile(np.eye(3), (6, 1, 1)))
    np.testing.assert_allclose(identity, np.tile(np.eye(4), (6, 1, 1)), atol=1e-15)
    with pytest.raises(ValueError, match="rotations have shape"):
        pose_transforms(skeleton, np.zeros((2, 5, 3, 3)))


def test_random_poses_follow_section_iv():
    skeleton = random_skeleton(41)
    axis = np.array([1.0, 2.0, -1.0])
    rotations = random_poses(skeleton, axis, 400, np.random.default_rng(0))
    vectors = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(400, 41, 3)
    along = vectors @ (axis / np.linalg.norm(axis))
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=2), np.abs(along), atol=1e-9)
    moved = np.abs(along) > 1e-6
    assert (moved.sum(axis=1) == 4).all()  # 10 % of 40
    assert not moved[:, 0].any()  # never the root
    assert (moved[:, 1:].sum(axis=0) > 10).all()  # every other bone takes its turn
    angles = np.abs(along[moved])
    assert angles.min() >= 0.1 * np.pi - 1e-9
    assert angles.max() <= 0.33 * np.pi + 1e-9
    assert abs(angles.mean() - 0.215 * np.pi) < 0.02 * np.pi
    assert abs((along[moved] > 0).mean() - 0.5) < 0.05


def test_random_poses_are_repeatable_and_move_at_least_one_bone():
    for skeleton in (random_skeleton(3), random_skeleton(1), random_skeleton(4, roots=4)):
        first = random_poses(skeleton, (0, 0, 1), 9, np.random.default_rng(7))
        again = random_poses(skeleton, (0, 0, 1), 9, np.random.default_rng(7))
        np.testing.assert_array_equal(first, again)
        assert (np.abs(first - np.eye(3)).max(axis=(2, 3)) > 0.1).sum(axis=1).tolist() == [1] * 9
    axes = np.random.default_rng(8).normal(size=(9, 3))
    turned = random_poses(random_skeleton(1), axes, 9, np.random.default_rng(7))
    np.testing.assert_allclose(np.einsum("pij,pj->pi", turned[:, 0], axes), axes, atol=1e-12)


def test_several_roots_may_turn_but_a_sole_root_may_not():
    assert turnable_bones(random_skeleton(5)).tolist() == [1, 2, 3, 4]
    assert turnable_bones(random_skeleton(5, roots=2)).tolist() == [0, 1, 2, 3, 4]
