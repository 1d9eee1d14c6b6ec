# SPDX-License-Identifier: GPL-3.0-or-later
"""Local maps of bones that stretch, mirror and bend."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.rig.bendy import BendyBone
from gskin_addon.core.rig.lbs import skin_cloud, skin_quats
from gskin_addon.core.rig.quaternion import matrix_to_quat, normalize, quat_multiply, quat_to_matrix
from gskin_addon.core.rig.stretch import polar, size, unevenness
from gskin_addon.core.splats.cloud import SplatCloud


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def cloud_of(count, rng):
    return SplatCloud(
        rng.normal(size=(count, 3)), normalize(rng.normal(size=(count, 4))), rng.uniform(0.01, 0.1, (count, 3)),
        np.full(count, 0.5), rng.normal(size=(count, 4, 3)),
    )  # fmt: skip


def covariance(cloud):
    axes = quat_to_matrix(cloud.quats.astype(float)) * cloud.scales[:, None, :]
    return axes @ axes.swapaxes(1, 2)


def transforms_of(linear):
    out = np.tile(np.eye(4), (len(linear), 1, 1))
    out[:, :3, :3] = linear
    return out


def test_polar_puts_any_map_together_again(rng):
    maps = rng.normal(size=(200, 3, 3))
    quats, stretch, parity = polar(maps)
    np.testing.assert_allclose(parity[:, None, None] * quat_to_matrix(quats) @ stretch, maps, atol=1e-12)
    assert (np.linalg.eigvalsh(stretch) > 0).all()
    np.testing.assert_array_equal(parity, np.sign(np.linalg.det(maps)))


def test_unevenness_tells_scale_from_stretch():
    turn = quat_to_matrix(normalize(np.array([1.0, 0.2, -0.4, 0.3])))
    own, even = unevenness(np.stack([turn, 2 * turn, turn @ np.diag([1, 1, 1.01]), -turn]))
    np.testing.assert_allclose(own, [0, 3 * np.sqrt(3) / 2, 0.01, 1], atol=1e-4)
    np.testing.assert_allclose(even, [0, 0, 0.0082, 0], atol=1e-4)
    np.testing.assert_allclose(size(np.stack([turn, 3 * turn])), [1, 3])


@pytest.mark.parametrize("mirror", [False, True])
def test_one_stretched_bone_maps_covariances(rng, mirror):
    linear = rng.normal(size=(1, 3, 3))
    linear *= np.sign(np.linalg.det(linear)) * (-1 if mirror else 1)
    cloud = cloud_of(30, rng)
    posed = skin_cloud(cloud, np.ones((30, 1)), transforms_of(linear))
    wanted = linear @ covariance(cloud) @ linear.swapaxes(1, 2)
    np.testing.assert_allclose(covariance(posed), wanted, atol=1e-5 * np.abs(wanted).max())


def test_bones_scaled_by_one_factor_turn_by_eq_3(rng):
    """A rig that is scaled as a whole looks as before, larger."""
    cloud, weights = cloud_of(40, rng), rng.dirichlet(np.ones(3), 40)
    linear = quat_to_matrix(normalize(rng.normal(0, 0.5, (3, 4)) + [1, 0, 0, 0]))
    posed = skin_cloud(cloud, weights, transforms_of(2 * linear))
    turned = quat_multiply(skin_quats(weights, transforms_of(linear)), cloud.quats)
    np.testing.assert_allclose(np.abs((posed.quats * turned).sum(axis=1)), 1, atol=1e-5)
    np.testing.assert_allclose(posed.scales, 2 * cloud.scales, rtol=1e-5)


def test_bones_scaled_differently_turn_by_the_local_map_and_blend_their_scales(rng):
    """Eq. 3 weighs a bone of half the size like one of twice: up to 11 degrees off what the blend does around a splat.

    Issue 18 asks for 1 degree; this test asked for Eq. 3 before.
    """
    cloud, weights = cloud_of(40, rng), rng.dirichlet(np.ones(3), 40)
    factors = np.array([1.0, 2.0, 0.5])
    linear = quat_to_matrix(normalize(rng.normal(0, 0.5, (3, 4)) + [1, 0, 0, 0])) * factors[:, None, None]
    posed = skin_cloud(cloud, weights, transforms_of(linear))
    u, _, vt = np.linalg.svd(np.einsum("nb,bij->nij", weights, linear))
    turned = quat_multiply(matrix_to_quat(u @ vt), cloud.quats)
    np.testing.assert_allclose(np.abs((posed.quats * turned).sum(axis=1)), 1, atol=1e-5)
    np.testing.assert_allclose(posed.scales, cloud.scales * (weights @ factors)[:, None], rtol=1e-5)


def test_rotations_are_what_they_were_to_the_bit(rng):
    """Also beside a stretched bone, which has no share in them."""
    cloud, weights = cloud_of(40, rng), rng.dirichlet(np.ones(3), 40).astype(np.float32)
    linear = quat_to_matrix(normalize(rng.normal(0, 0.5, (3, 4)) + [1, 0, 0, 0]))
    before = skin_cloud(cloud, weights, transforms_of(linear))
    more = np.concatenate([linear, linear[:1] @ np.diag([1.0, 2.0, 3.0])[None]])
    after = skin_cloud(cloud, np.concatenate([weights, np.zeros((40, 1), np.float32)], axis=1), transforms_of(more))
    np.testing.assert_array_equal(before.scales, cloud.scales)
    np.testing.assert_array_equal(after.scales, cloud.scales)
    np.testing.assert_allclose(after.quats, before.quats, atol=1e-6)


def test_going_over_from_rotation_to_stretch_is_smooth(rng):
    """A little stretch changes a little, also where bones that turn by 90 degrees are blended."""
    cloud, weights = cloud_of(20, rng), np.tile([0.8, 0.2], (20, 1))
    quarter = quat_to_matrix(normalize(np.array([1.0, 0, 1.0, 0])))
    last = None
    for amount in np.linspace(0, 0.03, 61):
        linear = np.stack([np.diag([1, 1, 1 + amount]), quarter])
        found = covariance(skin_cloud(cloud, weights, transforms_of(linear)))
        if last is not None:
            change = np.linalg.norm(found - last, axis=(1, 2)) / np.linalg.norm(found, axis=(1, 2))
            assert change.max() < 0.02
        last = found


def arc(segments, angle):
    """A bone along y of length 1 bent to an arc about x."""
    joints, place = [], np.zeros(3)
    for index in range(segments + 1):
        half = angle * index / segments / 2
        turn = quat_to_matrix(np.array([np.cos(half), np.sin(half), 0, 0]))
        rest = np.array([0, index / segments, 0])
        joint = np.eye(4)
        joint[:3, :3], joint[:3, 3] = turn, place - turn @ rest
        joints.append(joint)
        middle = angle * (index + 0.5) / segments
        place = place + np.array([0, np.cos(middle), np.sin(middle)]) / segments
    return BendyBone(np.array(joints), np.eye(4), 1.0)


def test_a_bendy_bone_has_the_jacobian_of_its_own_blend(rng):
    bone, step = arc(6, 1.2), 1e-6
    points = rng.uniform((-0.2, -0.3, -0.2), (0.2, 1.3, 0.2), (60, 3))
    _, maps, _, _, _ = bone.deform(points)
    for axis in range(3):
        offset = np.eye(3)[axis] * step
        slope = (bone.deform(points + offset)[0] - bone.deform(points - offset)[0]) / (2 * step)
        np.testing.assert_allclose(maps[:, :, axis], slope, atol=1e-6)
    assert bone.is_bent(np.eye(4))
    assert not arc(6, 0.0).is_bent(np.eye(4))


def test_splats_turn_with_the_arc_of_a_bendy_bone():
    """On the axis of the bone, in the middle of a segment, the turn is the arc's."""
    bone = arc(6, 1.2)
    along = (np.arange(6) + 0.5) / 6
    cloud = SplatCloud(
        np.stack([0 * along, along, 0 * along], axis=1), np.tile([1.0, 0, 0, 0], (6, 1)),
        np.tile([0.01, 0.05, 0.02], (6, 1)), np.ones(6), np.zeros((6, 1, 3)),
    )  # fmt: skip
    posed = skin_cloud(cloud, np.ones((6, 1)), np.eye(4)[None], bends={0: bone})
    np.testing.assert_allclose(2 * np.arctan2(posed.quats[:, 1], posed.quats[:, 0]), 1.2 * along, atol=1e-3)
    np.testing.assert_allclose(posed.scales, cloud.scales, rtol=0.01)
