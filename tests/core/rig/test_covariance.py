# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gskin_addon.core.rig.covariance import orthogonal_axes, transform_gaussians
from gskin_addon.core.rig.quaternion import quat_to_matrix


def covariance(quats, scales):
    axes = quat_to_matrix(quats) * scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


@given(st.integers(0, 2**32 - 1), st.floats(-6, 0))
@settings(max_examples=40, deadline=None)
def test_the_covariance_is_mapped(seed, thinnest):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(20, 4))
    scales = 10 ** rng.uniform(thinnest, 0, (20, 3))
    maps = np.eye(3) + rng.normal(0, 0.6, (20, 3, 3))  # mirrored ones too
    q, s = transform_gaussians(quats, scales, maps)
    wanted = maps @ covariance(quats, scales) @ maps.transpose(0, 2, 1)
    size = np.linalg.norm(wanted, axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(covariance(q, s) / size, wanted / size, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-12)
    # Volumes are products of all three scales: the thin ones must be right to their own size.
    np.testing.assert_allclose(s.prod(axis=1), np.abs(np.linalg.det(maps)) * scales.prod(axis=1), rtol=1e-8)


def test_axes_keep_their_order():
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(50, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = rng.permuted(np.tile([0.01, 0.011, 0.3], (50, 1)), axis=1)
    q, s = transform_gaussians(quats, scales, np.tile(np.eye(3), (50, 1, 1)))
    np.testing.assert_allclose(s, scales, rtol=1e-12)
    np.testing.assert_allclose(np.abs((q * quats).sum(axis=1)), 1, atol=1e-12)
    stretch = quat_to_matrix(quats) @ np.diag([5.0, 1.0, 0.2]) @ quat_to_matrix(quats).transpose(0, 2, 1)
    q, s = transform_gaussians(quats, scales, stretch)
    np.testing.assert_allclose(s, scales * [5, 1, 0.2], rtol=1e-10)


def test_flat_and_pointlike_splats_stay_so():
    scales = np.array([[0.1, 0.2, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    quats = np.random.default_rng(1).normal(size=(3, 4))
    maps = np.eye(3) + np.random.default_rng(2).normal(0, 0.3, (3, 3, 3))
    q, s = transform_gaussians(quats, scales, maps)
    np.testing.assert_array_equal(s == 0, scales == 0)
    np.testing.assert_allclose(
        covariance(q, s), maps @ covariance(quats, scales) @ maps.transpose(0, 2, 1), atol=1e-9
    )


def test_maps_that_lose_dimensions():
    columns = np.zeros((4, 3, 3))
    columns[1, :, 1] = [0, 0, 2]
    columns[2] = np.outer([1, 2, 2], [1, 1, 0])
    columns[3] = np.diag([1, 1, 0])
    axes, lengths = orthogonal_axes(columns)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1)
    back = (axes * lengths[:, None] ** 2) @ axes.transpose(0, 2, 1)
    np.testing.assert_allclose(back, columns @ columns.transpose(0, 2, 1), atol=1e-12)
