# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
import torch

from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.poses import random_poses
from gskin_addon.core.skinning.pose_kernels import pose_splats_fused
from gskin_addon.core.skinning.posing import pose_splats
from tests.helpers.limb import make_limb


@pytest.mark.parametrize(("bones", "poses"), [(3, 4), (9, 1), (2, 7)])
def test_values_and_gradients_equal_those_of_torch_in_float64(bones, poses):
    limb = make_limb(300, bones)
    rng = np.random.default_rng(bones)
    # Turns of up to two half circles: quaternions of both signs meet.
    rotations = random_poses(limb.skeleton, (0.3, 1, 0.2), poses, rng)
    transforms = pose_transforms(limb.skeleton, rotations)
    transforms[:, 0, :3, :3] = transforms[:, 0, :3, :3] @ np.diag([-1.0, -1.0, 1.0])
    start = rng.dirichlet(np.ones(bones), 300)
    pulls = rng.normal(size=(poses, 300, 3)), rng.normal(size=(poses, 300, 4))
    quats = limb.cloud.quats * rng.uniform(0.5, 2, (300, 1)).astype(np.float32)  # need not be unit

    slow = torch.tensor(start, requires_grad=True)
    means = torch.from_numpy(limb.cloud.means.astype(np.float64))
    expected = pose_splats(means, torch.from_numpy(quats.astype(np.float64)), slow, transforms)
    sum((e * torch.from_numpy(p)).sum() for e, p in zip(expected, pulls, strict=True)).backward()
    fast = torch.tensor(start, dtype=torch.float32, requires_grad=True)
    found = pose_splats_fused(limb.cloud.means, quats, fast, transforms)
    sum((f * torch.from_numpy(p).float()).sum() for f, p in zip(found, pulls, strict=True)).backward()

    for f, e in zip(found, expected, strict=True):
        np.testing.assert_allclose(f.detach(), e.detach(), atol=3e-6)
    np.testing.assert_allclose(fast.grad, slow.grad, rtol=2e-4, atol=2e-4)
