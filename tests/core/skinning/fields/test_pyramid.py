# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
import torch

from gskin_addon.core.skinning.fields import LOG_FLOOR
from gskin_addon.core.skinning.fields.pyramid import SparsePyramid


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


def test_gradient_reaches_the_parameters():
    rng = np.random.default_rng(2)
    field = SparsePyramid(rng.normal(size=(50, 3)), random_weights(rng, 50, 3), (4, 8)).double()
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


def test_query_agrees_with_the_field_at_its_own_points_and_knows_its_limits():
    rng = np.random.default_rng(4)
    points = rng.random((400, 3)) * (1, 1, 0.02)  # a plate
    field = SparsePyramid(points, np.full((400, 3), 1 / 3, np.float32))
    with torch.no_grad():
        field.theta.copy_(torch.from_numpy(rng.normal(size=field.theta.shape)))
    logits, known = field.query(points)
    assert known.all()
    np.testing.assert_allclose(logits, field.residual().detach(), atol=1e-5)
    between = rng.random((100, 3)) * (1, 1, 0.02)
    assert field.query(between)[1].mean() > 0.2
    assert not field.query(between + (0, 0, 0.4))[1].any()


def test_query_between_the_points_of_a_smooth_field():
    rng = np.random.default_rng(5)
    points = rng.random((3000, 3))
    field = SparsePyramid(points, np.full((3000, 1), 1.0, np.float32), (8,))
    with torch.no_grad():
        at = torch.from_numpy(np.stack(np.meshgrid(*[np.linspace(0, 1, 8)] * 3, indexing="ij"), -1).reshape(-1, 3))
        assert len(field.theta) == 512
        field.theta.copy_((at @ torch.tensor([1.0, 2.0, -1.0], dtype=torch.float64))[:, None])
    others = rng.random((50, 3))
    expected = np.diff(field.query(np.array([[0.2, 0.2, 0.2], [0.4, 0.2, 0.2]]))[0][:, 0])[0] / 0.2
    slope = np.array([1.0, 2.0, -1.0]) * expected
    found = field.query(others)[0][:, 0]
    np.testing.assert_allclose(found - found[0], (others - others[0]) @ slope, atol=2e-3)
