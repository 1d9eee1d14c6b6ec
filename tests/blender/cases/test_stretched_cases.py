# SPDX-License-Identifier: GPL-3.0-or-later
"""The shared cases of bendy and scaled bones: right values of `../shared/cases/README.md`."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from figure_files import CASES
from finite_differences import apart, covariances, shown, truth

from gskin_addon.core.splats.ply import read_ply
from gskin_addon.scene.armature import read_skeleton
from gskin_addon.scene.posing import posed_cloud, turn_bones
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import write_weights


def opened(folder: str, blend: str):
    """The case's figure, bound to its rig by distance: splats, armature, weights."""
    if not (CASES / folder / blend).is_file():
        pytest.skip(f"no {folder} in ../shared/cases")
    bpy.ops.wm.open_mainfile(filepath=str(CASES / folder / blend))
    armature = bpy.data.objects["Rig"]
    obj = create_splat_object(read_ply(CASES / folder / "fig.ply").cloud, "Splats")
    skeleton, points = read_skeleton(armature), read_cloud(obj).means
    ways = skeleton.tails - skeleton.heads
    along = np.einsum("nbd,bd->nb", points[:, None] - skeleton.heads, ways) / (ways**2).sum(axis=1)
    foot = skeleton.heads + np.clip(along, 0, 1)[:, :, None] * ways
    near = np.exp(-30 * np.linalg.norm(points[:, None] - foot, axis=2))
    weights = (near / near.sum(axis=1, keepdims=True)).astype(np.float32)
    write_weights(obj, armature, weights)
    return obj, armature, weights


def test_turns_follow_bendy_bones_and_all_outputs_agree():
    obj, armature, _ = opened("bbone", "bbone.blend")
    turn_bones(armature, {"hand.L": (0, -60, 0), "hand.R": (30, 0, 20)})
    live, real, cloud = shown(obj), truth(obj), posed_cloud(obj)
    np.testing.assert_allclose(cloud.means, real.points, atol=1e-5)
    np.testing.assert_allclose(live.points, real.points, atol=1e-5)
    assert apart(covariances(live.quats, live.scales), covariances(cloud.quats, cloud.scales)).max() < 0.02
    assert np.percentile(real.turn_error(live.turn), 99) < 1


@pytest.mark.parametrize(("bone", "scale"), [("spine", 2.0), ("hand.L", 2.0), ("spine", -1.0)])
def test_sizes_follow_scaled_bones(bone, scale):
    obj, armature, weights = opened("bone_scale", "rig.blend")
    rest = read_cloud(obj)
    armature.pose.bones[bone].scale = (scale, abs(scale), abs(scale))
    live, real, cloud = shown(obj), truth(obj), posed_cloud(obj)
    np.testing.assert_allclose(cloud.means, real.points, atol=1e-5)
    wanted = real.covariances(rest.quats, rest.scales)
    # Nothing turns, so blends of bones lose nothing either.
    for found in (live, cloud):
        assert apart(covariances(found.quats, found.scales), wanted).max() < 0.02
    if bone == "hand.L":
        own = weights[:, list(read_skeleton(armature).names).index(bone)] > 0.99
        np.testing.assert_allclose(live.scales[own], 2 * rest.scales[own], rtol=0.02)
