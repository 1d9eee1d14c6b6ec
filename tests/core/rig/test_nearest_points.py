# SPDX-License-Identifier: GPL-3.0-or-later
"""The nearest points against all distances, on clouds that are even, uneven, far away, or in one place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gskin_addon.core.rig.nearest_points import nearest_points


def check(points, queries, k):
    distance, index = nearest_points(points, queries, k)
    every = np.linalg.norm(np.asarray(queries, float)[:, None] - points, axis=2)
    np.testing.assert_allclose(distance, np.sort(every, axis=1)[:, :k], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.take_along_axis(every, index, 1), distance, rtol=1e-9, atol=1e-12)
    assert all(len(set(row)) == k for row in index.tolist())


def surface(count, rng):
    points = rng.normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [1, 0.4, 0.2]


@pytest.mark.parametrize("k", [1, 6, 33])
def test_clouds_of_several_kinds(k):
    rng = np.random.default_rng(k)
    body = surface(3000, rng)
    uneven = np.concatenate([body[:1000], 1e-4 * surface(1000, rng), 1e3 * surface(40, rng)])
    for points in (body, uneven, np.round(body, 1), body[:40], np.repeat(body[:60], 5, axis=0)):
        check(points, points[:700], k)
        check(points, rng.uniform(-3, 3, (300, 3)), k)
    check(body, body[5:6], k)


def test_strays_far_from_a_large_cloud():
    rng = np.random.default_rng(0)
    points, strays = surface(20_000, rng), rng.uniform(-50, 50, (40, 3))
    check(points, strays, 2)
    check(points.astype(np.float32), points[::500].astype(np.float32), 4)


def test_all_points_and_none():
    points = np.random.default_rng(0).random((7, 3))
    check(points, points, 7)
    check(np.zeros((50, 3)), np.zeros((3, 3)), 4)
    assert nearest_points(points, np.zeros((0, 3)), 2)[1].shape == (0, 2)
    for k in (0, 8):
        with pytest.raises(ValueError, match="of 7 points"):
            nearest_points(points, points, k)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 200), st.integers(1, 100), st.integers(1, 20), st.integers(0, 2**20), st.integers(0, 6))
def test_any_clouds(count, asked, k, seed, digits):
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.integers(-6, 6)
    points = np.round(rng.normal(size=(count, 3)), digits) * scale
    queries = np.round(rng.normal(size=(asked, 3)), digits) * scale
    distance, index = nearest_points(points, queries, min(k, count))
    every = np.linalg.norm(queries[:, None] - points, axis=2)
    np.testing.assert_allclose(distance, np.sort(every, axis=1)[:, : min(k, count)], rtol=1e-9, atol=1e-9 * scale)
    np.testing.assert_allclose(np.take_along_axis(every, index, 1), distance, rtol=1e-9, atol=1e-9 * scale)
