# SPDX-License-Identifier: GPL-3.0-or-later
"""The shipped network on the demo's own character, which it never saw."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from needs import WORKER, needs

needs("bpy", *WORKER)

from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.rig.poses import random_axes, random_poses
from gskin_addon.core.skinning.initial import initial_weights_geodesic
from gskin_addon.core.skinning.learned.predict import learned_weights
from gskin_addon.scene.armature import read_skeleton

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("count", "share"), [(40_000, 0.7), (12_000, 0.8)])
def test_learned_weights_of_brindle_are_better_than_distances(count, share):
    """With the demo's own number of splats, and with few, of which the cape and the back behind it share voxels."""
    sys.path.insert(0, str(ROOT))
    try:
        from demo import character
    finally:
        sys.path.remove(str(ROOT))
    brindle = character.build()
    cloud, truth = character.to_splats(brindle, count, seed=0)
    skeleton = read_skeleton(brindle.rig)
    truth = truth[:, [brindle.bones.index(name) for name in skeleton.names]]
    learned, confidence = learned_weights(cloud, skeleton)
    plain = initial_weights_geodesic(
        cloud.means, cloud.opacities, skeleton, scales=cloud.scales, quats=cloud.quats
    )
    rng = np.random.default_rng(977)
    poses = pose_transforms(skeleton, random_poses(skeleton, random_axes(24, rng), 24, rng))
    points = cloud.means.astype(float)
    true = skin_points(points, truth, poses)
    errors = [np.linalg.norm(skin_points(points, w, poses) - true, axis=-1).mean() for w in (learned, plain)]
    assert errors[0] < share * errors[1]
    wrong = np.abs(learned - truth).sum(axis=1)
    assert np.corrcoef(confidence, wrong)[0, 1] < -0.2
