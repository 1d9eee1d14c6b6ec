# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from proxy_meshes import tube
from scipy.spatial.transform import Rotation

from gskin_addon.core.rig.anchoring import anchor_splats, anchored_points, splat_maps
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.rig.quaternion import matrix_to_quat, nearest_rotation, quat_multiply
from gskin_addon.core.rig.vertex_maps import vertex_transforms
from gskin_addon.core.skinning.posers import AnchoredPoser, SplatPoser, matrix_quats, polar_rotation
from gskin_addon.core.skinning.posing import pose_splats
from tests.helpers.limb import make_limb


@pytest.fixture(scope="module")
def scene():
    limb = make_limb(300)
    verts, faces = tube(rings=37, sides=12)
    weights = np.exp(-5 * np.square(verts[:, :1] - [0.5, 1.5, 2.5]))
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.3, (6, 3))).as_matrix()
    transforms = pose_transforms(limb.skeleton, turns.reshape(2, 3, 3, 3))
    return limb, verts, faces, weights, transforms


def test_anchored_splats_are_where_numpy_puts_them(scene):
    limb, verts, faces, weights, transforms = scene
    anchors = anchor_splats(limb.cloud.means, verts, faces)
    posed = AnchoredPoser(limb.cloud, anchors, verts, faces).pose(torch.from_numpy(weights), transforms)
    for pose in range(2):
        moved = skin_points(verts, weights, transforms[pose])
        np.testing.assert_allclose(posed.nodes[pose], moved, atol=1e-5)
        np.testing.assert_allclose(posed.means[pose], anchored_points(anchors, moved, faces), atol=2e-5)
        rotation, shear = vertex_transforms(verts, moved, faces)
        eye = np.tile(np.eye(3), (len(verts), 1, 1))
        turn = matrix_to_quat(nearest_rotation(splat_maps(anchors, rotation, eye, faces)))
        agree = np.abs((posed.quats[pose].numpy() * quat_multiply(turn, limb.cloud.quats)).sum(-1))
        assert 2 * np.arccos(np.clip(agree, -1, 1)).max() < 0.005
        assert shear.max() > 1.05  # so that this pose is no rigid motion


@pytest.mark.parametrize("edges_only", [False, True])
def test_vertices_of_a_swollen_mesh_turn_as_numpy_says(scene, edges_only):
    """Rings that grow weigh their normals more, in both; splats at a vertex turn as it does."""
    limb, verts, faces, weights, transforms = scene
    swollen = transforms.copy()
    head = limb.skeleton.heads[1]
    swollen[:, 1, :3, 3] -= 0.4 * swollen[:, 1, :3, :3] @ head
    swollen[:, 1, :3, :3] *= 1.4
    anchors = anchor_splats(limb.cloud.means, verts, faces)
    anchors = replace(anchors, bary=np.eye(3)[np.arange(anchors.count) % 3])
    poser = AnchoredPoser(limb.cloud, anchors, verts, faces, edges_only=edges_only)
    quats = poser.pose(torch.from_numpy(weights), swollen).quats[0].numpy()
    moved, found = skin_points(verts, weights, swollen[0]), []
    for other in (edges_only, not edges_only):
        rotation, _ = vertex_transforms(verts, moved, faces, edges_only=other)
        turn = matrix_to_quat(rotation[faces[anchors.face, anchors.bary.argmax(1)]])
        agree = np.abs((quats * quat_multiply(turn, limb.cloud.quats)).sum(-1))
        found.append(2 * np.arccos(np.clip(agree, -1, 1)).max())
    assert found[0] < 0.003
    assert found[1] > 0.02


def test_vanilla_splats_are_posed_as_before(scene):
    limb, _, _, _, transforms = scene
    weights = torch.from_numpy(limb.weights)
    posed = SplatPoser(limb.cloud).pose(weights, transforms)
    cloud = limb.cloud
    means, quats = pose_splats(torch.from_numpy(cloud.means), torch.from_numpy(cloud.quats), weights, transforms)
    torch.testing.assert_close(posed.means, means)
    torch.testing.assert_close(posed.quats, quats)
    assert posed.nodes is posed.means


def test_gradients_are_those_of_small_steps(scene):
    limb, verts, faces, weights, transforms = scene
    poser = AnchoredPoser(limb.cloud, anchor_splats(limb.cloud.means, verts, faces), verts, faces)
    for name in ("_quats", "_verts", "_bary", "_local", "_coefficients", "_shares", "_reach"):
        setattr(poser, name, getattr(poser, name).double())
    rng = np.random.default_rng(3)
    pull = [torch.from_numpy(rng.normal(size=(2, 300, k))) for k in (3, 4)]

    def value(w):
        posed = poser.pose(w, transforms)
        return (posed.means * pull[0]).sum() + (posed.quats * pull[1]).sum()

    start = torch.from_numpy(weights.astype(np.float64)).requires_grad_()
    value(start).backward()
    for _ in range(4):
        step = torch.from_numpy(rng.normal(size=weights.shape))
        far = 1e-5
        with torch.no_grad():
            slope = (value(start + far * step) - value(start - far * step)) / (2 * far)
        np.testing.assert_allclose(float((start.grad * step).sum()), float(slope), rtol=1e-4)


def test_collapsed_and_mirrored_poses_keep_finite_gradients(scene):
    limb, verts, faces, weights, transforms = scene
    poser = AnchoredPoser(limb.cloud, anchor_splats(limb.cloud.means, verts, faces), verts, faces)
    for linear in (np.zeros((3, 3)), np.diag([1.0, 1.0, -1.0]), np.diag([1.0, 0.0, 0.0])):
        squashed = transforms.copy()
        squashed[..., :3, :3] = linear
        start = torch.from_numpy(weights).requires_grad_()
        posed = poser.pose(start, squashed)
        (posed.means.square().sum() + posed.quats[..., 0].sum()).backward()
        assert torch.isfinite(posed.means).all()
        assert torch.isfinite(posed.quats).all()
        assert torch.isfinite(start.grad).all()


def test_polar_and_quaternions_equal_numpy():
    rng = np.random.default_rng(0)
    maps = np.eye(3) + rng.normal(0, 0.4, (200, 3, 3))
    maps = maps[np.linalg.det(maps) > 0.05]
    rotation = polar_rotation(torch.from_numpy(maps))
    np.testing.assert_allclose(rotation, nearest_rotation(maps), atol=1e-6)
    quats = matrix_quats(torch.from_numpy(Rotation.random(200, random_state=1).as_matrix()))
    wanted = matrix_to_quat(Rotation.random(200, random_state=1).as_matrix())
    np.testing.assert_allclose(np.abs((quats.numpy() * wanted).sum(-1)), 1, atol=1e-12)
