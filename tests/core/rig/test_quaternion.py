# SPDX-License-Identifier: GPL-3.0-or-later
"""Quaternions against rotation matrices and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gskin_addon.core.rig.quaternion import (
    axis_angle_to_matrix,
    matrix_to_quat,
    nearest_rotation,
    normalize,
    quat_multiply,
    quat_to_matrix,
)


def _random_quats(count: int, seed: int = 0) -> np.ndarray:
    return normalize(np.random.default_rng(seed).normal(size=(count, 4)))


def test_matrices_agree_with_scipy():
    q = _random_quats(200)
    expected = Rotation.from_quat(np.roll(q, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(quat_to_matrix(q), expected, atol=1e-14)
    np.testing.assert_allclose(quat_to_matrix(3.7 * q), expected, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, np.pi / 2, np.pi - 1e-7, np.pi])
def test_matrix_to_quat_inverts_also_at_half_turns(angle):
    axes = np.concatenate([np.eye(3), np.random.default_rng(1).normal(size=(50, 3))])
    m = axis_angle_to_matrix(axes, np.full(len(axes), angle))
    q = matrix_to_quat(m)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(quat_to_matrix(q), m, atol=1e-12)
    assert (q[:, 0] >= 0).all()


def test_product_is_composition_and_broadcasts():
    a, b = _random_quats(64, 1), _random_quats(64, 2)
    np.testing.assert_allclose(
        quat_to_matrix(quat_multiply(a, b)), quat_to_matrix(a) @ quat_to_matrix(b), atol=1e-14
    )
    assert quat_multiply(a[:, None], b[None]).shape == (64, 64, 4)
    assert quat_multiply(a.astype(np.float32), b.astype(np.float32)).dtype == np.float32


def test_normalize_turns_zero_into_identity():
    q = normalize(np.array([[0.0, 0, 0, 0], [0, 2, 0, 0]]))
    np.testing.assert_array_equal(q, [[1, 0, 0, 0], [0, 1, 0, 0]])


def test_axis_angle_agrees_with_scipy_and_broadcasts():
    rng = np.random.default_rng(3)
    axis, angle = rng.normal(size=(30, 3)), rng.uniform(-4, 4, 30)
    expected = Rotation.from_rotvec(axis / np.linalg.norm(axis, axis=1)[:, None] * angle[:, None]).as_matrix()
    np.testing.assert_allclose(axis_angle_to_matrix(axis, angle), expected, atol=1e-13)
    np.testing.assert_allclose(axis_angle_to_matrix(axis[0], angle)[0], expected[0], atol=1e-13)
    assert axis_angle_to_matrix([0, 0, 1], 0.5).shape == (3, 3)


def test_nearest_rotation_is_the_polar_rotation():
    rng = np.random.default_rng(4)
    r = quat_to_matrix(_random_quats(20))
    s = rng.normal(size=(20, 3, 3))
    s = np.eye(3) + 0.2 * (s + s.transpose(0, 2, 1)) / 2
    np.testing.assert_allclose(nearest_rotation(r @ s), r, atol=1e-12)
    mirrored = nearest_rotation(r * np.array([1, 1, -1]))
    np.testing.assert_allclose(np.linalg.det(mirrored), 1, atol=1e-12)
