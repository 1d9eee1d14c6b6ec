# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's own Python has numpy only: what its side of the house and the default job use must run there."""

from __future__ import annotations

import pytest
from without import output_without

HEAVY = ("scipy", "numba", "torch", "PIL", "trimesh", "safetensors")


def run(code: str) -> str:
    """What the code prints in a Python that has numpy only."""
    return output_without(HEAVY, code)


def test_rig_and_the_names_of_initial_weights_need_numpy_only():
    out = run(
        "from gskin_addon.core.rig import anchoring, kinematics, lbs, mesh_weights, poses, quaternion, skeleton\n"
        "from gskin_addon.core.skinning.initial import INITIAL_WEIGHTS\n"
        "print(*INITIAL_WEIGHTS)\n"
    )
    assert out.split() == ["learned", "visibility", "geodesic", "heat"]


@pytest.mark.parametrize("name", ["learned", "heat", "geodesic", "visibility"])
def test_weights_need_numpy_only(name):
    """Every method on a forked tube, a stray among its splats, and the subset that a job learns on."""
    out = run(
        "import numpy as np\n"
        "from gskin_addon.core.render.camera import paper_views\n"
        "from gskin_addon.core.rig.skeleton import Skeleton\n"
        "from gskin_addon.core.skinning.initial import initial_with_confidence\n"
        "from gskin_addon.core.skinning.subset import choose_subset, follow_nearest\n"
        "from gskin_addon.core.splats.cleanup import find_strays\n"
        "from gskin_addon.core.splats.cloud import SplatCloud\n"
        "rng = np.random.default_rng(0)\n"
        "angle, along = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(0, 1, 3000)\n"
        "points = np.stack([along, 0.1 * np.cos(angle), 0.1 * np.sin(angle)], axis=1)\n"
        "points = np.concatenate([points, points[:1000] * [1, 1, 0.5] + [0, 0.5, 0], [[9, 9, 9]]]).astype(np.float32)\n"
        "n = len(points)\n"
        "cloud = SplatCloud(points, np.tile(np.float32([1, 0, 0, 0]), (n, 1)), np.full((n, 3), 0.01, np.float32),\n"
        "                   np.ones(n, np.float32), np.zeros((n, 1, 3), np.float32))\n"
        "heads = np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]], float)\n"
        "skeleton = Skeleton(('a', 'b', 'c'), np.array([-1, 0, 0]), heads, heads + [0.5, 0, 0])\n"
        "cameras = paper_views(points[:-1].min(0), points[:-1].max(0), 32)\n"
        "masks = np.ones((len(cameras), 32, 32), bool)\n"
        f"weights, sure = initial_with_confidence({name!r}, cloud, skeleton, masks, cameras)\n"
        "strays = find_strays(cloud)\n"
        "assert strays[-1]\n"
        "weights = follow_nearest(points, weights, strays)\n"
        "assert choose_subset(cloud, 0, 500, ignored=strays).cloud.count > 400\n"
        "assert np.allclose(weights.sum(1), 1, atol=1e-5) and weights.shape == (n, 3)\n"
        "assert (weights[:3000][along < 0.4].argmax(1) == 0).mean() > 0.95\n"
        "assert (weights[:3000][along > 0.6].argmax(1) == 1).mean() > 0.95\n"
        "print('ok')\n"
    )
    assert out.split() == ["ok"]
