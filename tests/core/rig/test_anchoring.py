# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from proxy_meshes import grid, tube
from scipy.spatial.transform import Rotation
from splat_clouds import random_cloud

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.anchoring import (
    BETA,
    anchor_splats,
    anchored_points,
    check_fit,
    pose_anchored,
    splat_maps,
)
from gskin_addon.core.rig.lbs import skin_cloud
from gskin_addon.core.rig.mesh_weights import splat_weights
from gskin_addon.core.rig.quaternion import quat_to_matrix
from gskin_addon.core.rig.vertex_maps import vertex_transforms
from gskin_addon.core.splats.cloud import SplatCloud


def cloud_on(verts, faces, count=300, spread=0.02, degree=0, seed=0):
    rng = np.random.default_rng(seed)
    corner = verts[faces[rng.integers(0, len(faces), count)]]
    means = np.einsum("nk,nkd->nd", rng.dirichlet([1, 1, 1], count), corner) + rng.normal(0, spread, (count, 3))
    base = random_cloud(count, degree, seed)
    return SplatCloud(means, base.quats, base.scales, base.opacities, base.sh)


def covariance(cloud):
    axes = quat_to_matrix(cloud.quats.astype(float)) * cloud.scales[:, None, :].astype(float)
    return axes @ axes.transpose(0, 2, 1)


def slow_centre(anchors, n, posed, faces, residual=True):
    """Eq. 4 of one splat, word by word."""
    v = posed[faces[anchors.face[n]]]
    normal = np.cross(v[1] - v[0], v[2] - v[0])
    area = np.linalg.norm(normal) / 2
    normal = normal / np.linalg.norm(normal)
    r = np.prod([np.linalg.norm(v[i] - v[j]) for i, j in ((0, 1), (1, 2), (2, 0))]) / (4 * area)
    centre = anchors.bary[n] @ v + anchors.beta[n] * r * normal
    if residual:
        along = (v[1] - v[0]) / np.linalg.norm(v[1] - v[0])
        frame = np.stack([along, np.cross(normal, along), normal], axis=1)
        centre = centre + r * frame @ anchors.residual[n]
    return centre


def test_centres_are_those_of_equation_4():
    verts, faces = tube()
    cloud = cloud_on(verts, faces, spread=0.1)
    posed = verts + np.random.default_rng(1).normal(0, 0.02, verts.shape)
    for keep in (True, False):
        anchors = anchor_splats(cloud.means, verts, faces, keep_residual=keep, growth=1e9)
        fast = anchored_points(anchors, posed, faces)
        slow = [slow_centre(anchors, n, posed, faces, keep) for n in range(cloud.count)]
        np.testing.assert_allclose(fast, slow, atol=1e-12)
        np.testing.assert_allclose(anchored_points(anchors, np.stack([posed, verts]), faces)[0], fast, atol=0)


def test_the_bound_of_the_circumradius_acts_on_needles_only():
    verts, faces = grid()
    cloud = cloud_on(verts, faces, 200, 0.05)
    free, bound = (anchor_splats(cloud.means, verts, faces, growth=growth) for growth in (1e9, 1.5))
    for stretch in (1.0, 2.0, 0.5):
        posed = verts * [stretch, 1, 1]
        np.testing.assert_array_equal(anchored_points(bound, posed, faces), anchored_points(free, posed, faces))
    np.testing.assert_array_equal(*(anchored_points(a, 9 * verts, faces) for a in (free, bound)))
    needles = verts * [40, 1, 1]
    far, near = (np.abs(anchored_points(a, needles, faces)[:, 2]).max() for a in (free, bound))
    assert near < 10 * np.abs(cloud.means[:, 2]).max() < far
    assert np.isfinite(anchored_points(bound, verts * [1, 0, 0], faces)).all()


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.5))
@settings(max_examples=25, deadline=None)
def test_rest_is_met_exactly_with_the_residual_and_to_its_miss_without(seed, spread):
    verts, faces = tube(rings=9, sides=7)
    cloud = cloud_on(verts, faces, 60, spread, seed=seed)
    anchors = anchor_splats(cloud.means, verts, faces)
    assert np.abs(anchors.beta).max() <= BETA
    assert anchors.bary.min() >= 0
    np.testing.assert_allclose(anchors.bary.sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(anchored_points(anchors, verts, faces), cloud.means, atol=1e-10)
    bare = anchor_splats(cloud.means, verts, faces, keep_residual=False)
    left = np.linalg.norm(anchored_points(bare, verts, faces) - cloud.means, axis=1)
    np.testing.assert_allclose(left, bare.miss, atol=1e-9)
    assert bare.summary()["clamped"] == int((np.abs(bare.beta) == BETA).sum())


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=10, deadline=None)
def test_rigid_motion_moves_the_splats_rigidly(seed):
    verts, faces = tube(rings=9, sides=7)
    cloud = cloud_on(verts, faces, 80, 0.1, degree=2, seed=seed)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    motion[:3, 3] = [1, -2, 3]
    anchors = anchor_splats(cloud.means, verts, faces)
    posed = pose_anchored(cloud, anchors, verts, verts @ motion[:3, :3].T + motion[:3, 3], faces)
    wanted = skin_cloud(cloud, np.ones((80, 1)), motion[None])
    np.testing.assert_allclose(posed.means, wanted.means, atol=1e-6)
    np.testing.assert_allclose(posed.scales, cloud.scales, rtol=1e-6)
    np.testing.assert_allclose(np.abs((posed.quats * wanted.quats).sum(axis=1)), 1, atol=1e-6)
    np.testing.assert_allclose(posed.sh, wanted.sh, atol=1e-5)


def test_stretch_of_a_sheet_stretches_its_splats():
    verts, faces = grid()
    cloud = cloud_on(verts, faces, 200, 0.01)
    linear = np.array([[2.0, 0.6, 0], [0, 0.5, 0], [0, 0, 1]])
    anchors = anchor_splats(cloud.means, verts, faces)
    posed = pose_anchored(cloud, anchors, verts, verts @ linear.T, faces)
    wanted = linear @ covariance(cloud) @ linear.T
    size = np.linalg.norm(wanted, axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(covariance(posed) / size, wanted / size, atol=1e-5)


def test_covariances_are_those_of_equation_5():
    verts, faces = tube()
    cloud = cloud_on(verts, faces)
    posed = verts + np.random.default_rng(1).normal(0, 0.02, verts.shape)
    anchors = anchor_splats(cloud.means, verts, faces)
    rotation, shear = vertex_transforms(verts, posed, faces)
    result = covariance(pose_anchored(cloud, anchors, verts, posed, faces))
    for n in range(0, cloud.count, 17):
        corners = faces[anchors.face[n]]
        T = sum(w * rotation[v] for w, v in zip(anchors.bary[n], corners, strict=True)) @ sum(
            w * shear[v] for w, v in zip(anchors.bary[n], corners, strict=True)
        )
        np.testing.assert_allclose(splat_maps(anchors, rotation, shear, faces)[n], T, atol=1e-12)
        wanted = T @ covariance(cloud)[n] @ T.T
        np.testing.assert_allclose(result[n], wanted, atol=1e-5 * np.linalg.norm(wanted))


def test_meshes_with_faults_still_carry_splats():
    verts, faces = tube(rings=9, sides=7)
    cloud = cloud_on(verts, faces)
    # Slivers, a doubled face, a face turned over, a third face at an edge, a loose vertex.
    faults = [[0, 1, 1], [0, 0, 0], faces[3], faces[4][::-1], [faces[5][0], faces[5][1], len(verts)]]
    verts = np.concatenate([verts, [[0.1, 2, 0.3], [7, 7, 7]]])
    faces = np.concatenate([faces, faults])
    anchors = anchor_splats(cloud.means, verts, faces)
    assert not np.isin(anchors.face, len(faces) - 5 + np.arange(2)).any()
    turn = Rotation.from_rotvec([1, 2, 3]).as_matrix()
    posed = pose_anchored(cloud, anchors, verts, verts @ turn.T, faces)
    np.testing.assert_allclose(posed.means, cloud.means @ turn.T, atol=1e-5)
    np.testing.assert_allclose(posed.scales, cloud.scales, rtol=1e-5)


@pytest.mark.parametrize(
    ("verts", "faces", "words"),
    [
        (np.zeros((3, 3)), [[0, 1, 2]], "no triangle with an area"),
        (np.eye(3), np.zeros((0, 3), int), "no faces"),
        (np.eye(3), [[0, 1, 3]], "vertices that do not exist"),
        (np.eye(3) * np.nan, [[0, 1, 2]], "not finite"),
        (np.eye(3), [[0, 1, 2, 2]], "triangulate it"),
        (np.eye(3), [[0.0, 1.0, 2.0]], "not whole numbers"),
    ],
)
def test_useless_meshes_are_refused_by_name(verts, faces, words):
    with pytest.raises(InputError, match=f"'Body' has.*{words}"):
        anchor_splats(np.zeros((4, 3)), verts, faces, label="'Body'")


def test_a_mesh_somewhere_else_is_refused():
    verts, faces = tube()
    cloud = cloud_on(verts, faces)
    check_fit(anchor_splats(cloud.means, verts, faces), cloud.means, verts, faces)
    far = verts * 100
    with pytest.raises(InputError, match="does not fit the splats"):
        check_fit(anchor_splats(cloud.means, far, faces), cloud.means, far, faces)
    with pytest.raises(InputError, match="not finite"):
        anchor_splats(cloud.means * np.inf, verts, faces)


def test_weights_go_from_mesh_to_splats():
    verts, faces = tube()
    cloud = cloud_on(verts, faces, 3000, 0.005)
    anchors = anchor_splats(cloud.means, verts, faces)
    smooth = np.exp(-4 * np.square(verts[:, :1] - [0, 1.5, 3]))
    smooth = (smooth / smooth.sum(axis=1, keepdims=True)).astype(np.float32)
    on_splats = splat_weights(anchors, smooth, faces)
    blend = np.zeros((anchors.count, len(verts)))
    np.add.at(blend, (np.arange(anchors.count)[:, None], faces[anchors.face]), anchors.bary)
    np.testing.assert_allclose(on_splats, blend @ smooth, atol=1e-6)
    np.testing.assert_allclose(on_splats.sum(axis=1), 1, atol=1e-6)
