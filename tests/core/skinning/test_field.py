# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from gskin_addon.core.skinning.field import LOG_FLOOR, SparsePyramid, trilinear_matrix
from gskin_addon.core.skinning.subset import choose_subset
from tests.helpers.limb import make_limb


def random_weights(rng, splats, bones):
    weights = rng.random((splats, bones)) ** 3 + 1e-3
    return weights / weights.sum(1, keepdims=True)


def test_starts_at_the_initial_weights():
    rng = np.random.default_rng(0)
    initial = random_weights(rng, 300, 5)
    field = SparsePyramid(rng.normal(size=(300, 3)), initial)
    np.testing.assert_allclose(field().detach(), initial, rtol=1e-4, atol=1e-6)


def test_weights_below_the_floor_start_at_the_floor():
    initial = np.array([[1.0, 0.0], [0.5, 0.5]])
    start = SparsePyramid(np.eye(3)[:2], initial)().detach().numpy()
    assert start[0, 1] == pytest.approx(LOG_FLOOR, rel=1e-2)


def test_interpolation_is_trilinear():
    """A dense grid sampled by scipy, against the sparse matrix applied to the corners it touches."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (400, 3))
    matrix, corners = trilinear_matrix(points, (9,))
    lower, upper = np.percentile(points, [0.1, 99.9], axis=0)
    side = (upper - lower).max() * 1.02
    unit = np.clip((points - (lower + upper) / 2) / side + 0.5, 0, 1) * 8
    # A linear function is reproduced exactly, so corner values can be found by least squares.
    dense = rng.normal(size=(9, 9, 9))
    base = np.minimum(unit.astype(int), 7)
    keys = [(base + c) @ (81, 9, 1) for c in np.ndindex(2, 2, 2)]
    touched = np.unique(np.stack(keys))
    assert corners == len(touched)
    expected = map_coordinates(dense, unit.T, order=1)
    np.testing.assert_allclose(matrix @ dense.ravel()[touched], expected, atol=1e-9)


def test_gradient_reaches_the_parameters():
    rng = np.random.default_rng(2)
    field = SparsePyramid(rng.normal(size=(50, 3)), random_weights(rng, 50, 3), (4, 8)).double()
    field._matrix, field._transposed = field._matrix.double(), field._transposed.double()
    field._prior = field._prior.double()
    with torch.no_grad():
        field.theta.copy_(torch.from_numpy(rng.normal(size=tuple(field.theta.shape))))
    target = torch.from_numpy(rng.random((50, 3)))

    def loss():
        return (field() * target).sum()

    loss().backward()
    analytic = field.theta.grad.clone()
    for row, column in ((0, 0), (5, 1), (11, 2)):
        with torch.no_grad():
            field.theta[row, column] += 1e-5
            above = loss()
            field.theta[row, column] -= 2e-5
            below = loss()
            field.theta[row, column] += 1e-5
        assert float(analytic[row, column]) == pytest.approx(float(above - below) / 2e-5, rel=1e-4, abs=1e-8)


def test_subset_spreads_what_it_learned():
    limb = make_limb(3000)
    subset = choose_subset(limb.cloud, seed=0, limit=1000)
    assert subset.cloud.count == 1000
    flat = np.full_like(limb.weights, 1 / 3)
    learned = limb.weights[subset.index]
    spread = subset.spread(learned, flat[subset.index], flat)
    np.testing.assert_array_equal(spread[subset.index], learned)
    np.testing.assert_allclose(spread.sum(1), 1, atol=1e-5)
    assert np.abs(spread - limb.weights).sum(1).mean() < 0.05  # uniform weights are off by 1.3


def test_small_clouds_are_taken_whole():
    limb = make_limb(500)
    subset = choose_subset(limb.cloud, seed=0)
    assert subset.cloud is limb.cloud
    assert subset.spread(limb.weights, limb.weights, limb.weights) is limb.weights
