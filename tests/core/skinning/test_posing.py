# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_points, skin_quats
from gskin_addon.core.rig.quaternion import quat_multiply
from gskin_addon.core.skinning.coupling import coupling_loss, prepare_coupling
from gskin_addon.core.skinning.posing import pose_splats
from tests.helpers.limb import make_limb


def random_poses(limb, count, seed=0):
    rotations = Rotation.random(count * limb.skeleton.count, random_state=seed).as_matrix()
    return pose_transforms(limb.skeleton, rotations.reshape(count, -1, 3, 3))


def test_torch_posing_equals_numpy_skinning():
    limb = make_limb(400)
    transforms = random_poses(limb, 3)
    rest = (limb.cloud.means, limb.cloud.quats, limb.weights)
    means, quats = pose_splats(*(torch.from_numpy(a.astype(np.float64)) for a in rest), transforms)
    np.testing.assert_allclose(means, skin_points(limb.cloud.means.astype(float), limb.weights, transforms), atol=1e-5)
    for pose in range(3):
        expected = quat_multiply(skin_quats(limb.weights, transforms[pose]), limb.cloud.quats)
        agree = np.abs((quats[pose].numpy() * expected).sum(-1))
        np.testing.assert_allclose(agree, 1, atol=1e-6)


def test_coupling_equals_its_formula_and_vanishes_for_rigid_motion():
    limb = make_limb(400)
    coupling = prepare_coupling(limb.cloud.means, limb.skeleton, per_bone=3, neighbours=4)
    transforms = random_poses(limb, 2, seed=1)
    posed = skin_points(limb.cloud.means, limb.weights, transforms)
    expected = 0.0
    for pose in range(2):
        for point, bone, near in zip(coupling.points.numpy(), coupling.bone, coupling.neighbours.numpy(), strict=True):
            moved = transforms[pose, bone, :3, :3] @ point + transforms[pose, bone, :3, 3]
            for k in near:
                before = np.linalg.norm(point - limb.cloud.means[k])
                expected += (before - np.linalg.norm(moved - posed[pose, k])) ** 2
    found = coupling_loss(coupling, torch.from_numpy(posed), transforms)
    np.testing.assert_allclose(float(found), expected / (2 * 9 * 4), rtol=1e-3)

    rigid = np.repeat(transforms[:, :1], limb.skeleton.count, axis=1)
    still = skin_points(limb.cloud.means, limb.weights, rigid)
    assert float(coupling_loss(coupling, torch.from_numpy(still), rigid)) < 1e-9


def test_coupling_points_lie_between_the_joints_wherever_the_tails_are():
    limb = make_limb(400)
    stubs = replace(limb.skeleton, tails=limb.skeleton.heads + (0.01, 0, 0))
    honest, coupling = (prepare_coupling(limb.cloud.means, s, per_bone=3) for s in (limb.skeleton, stubs))
    np.testing.assert_allclose(coupling.points.numpy(), honest.points.numpy(), atol=1e-6)
    np.testing.assert_array_equal(coupling.bone, honest.bone)

    # A bone from which two hang spans both ways, and all its points move with it.
    heads = np.array([[0, 0, 0], [1, 1, 0], [1, -1, 0.0]])
    fork = replace(limb.skeleton, parents=np.array([-1, 0, 0]), heads=heads, tails=heads + (0.01, 0, 0))
    coupling = prepare_coupling(limb.cloud.means, fork, per_bone=2)
    own = coupling.points.numpy()[coupling.bone == 0]
    np.testing.assert_allclose(own, [(0.25, 0.25, 0), (0.75, 0.75, 0), (0.25, -0.25, 0), (0.75, -0.75, 0)])
