# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
import torch

from gskin_addon.core.skinning.fields.base import LOG_FLOOR
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
