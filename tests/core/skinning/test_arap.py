# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gskin_addon.core.skinning.arap import arap_loss
from gskin_addon.core.skinning.rotations import closest_rotation


def svd_rotation(S):
    u, _, vt = np.linalg.svd(S)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


@pytest.mark.parametrize("flat", [1.0, 0.1, 0.0])
def test_closest_rotation_is_that_of_the_svd(flat):
    rng = np.random.default_rng(3)
    for _ in range(200):
        rest = rng.normal(size=(12, 3)) * (1, 1, flat) * 10 ** rng.uniform(-4, 3)
        posed = rest @ Rotation.random(random_state=rng).as_matrix().T + 0.05 * rest[::-1]
        found = np.empty((3, 3))
        closest_rotation(posed.T @ rest, found)
        np.testing.assert_allclose(found, svd_rotation(posed.T @ rest), atol=1e-9)


def test_closest_rotation_of_nothing_is_the_identity():
    found = np.full((3, 3), np.nan)
    closest_rotation(np.zeros((3, 3)), found)
    np.testing.assert_array_equal(found, np.eye(3))


def reference_loss(rest, posed, nodes, neighbours):
    """Eq. 10 in float64 torch, rotations by SVD."""
    total = torch.zeros((), dtype=torch.float64)
    for p in range(len(posed)):
        for row, j in enumerate(nodes):
            edges = rest[neighbours[row]] - rest[j]
            moved = posed[p, neighbours[row]] - posed[p, j]
            rotation = torch.from_numpy(svd_rotation((moved.T @ edges).detach().numpy()))
            total = total + (moved - edges @ rotation.T).square().sum()
    return total / (2 * neighbours.size * len(posed))


def test_loss_and_gradient_equal_the_float64_reference():
    rng = np.random.default_rng(0)
    rest = rng.normal(size=(40, 3))
    posed = rest @ Rotation.from_rotvec([0.3, 1.0, -0.4]).as_matrix().T + 0.2 * rng.normal(size=(3, 40, 3))
    nodes = rng.choice(40, 15, replace=False)
    neighbours = np.stack([rng.choice(np.delete(np.arange(40), j), 6, replace=False) for j in nodes])
    value, grad = arap_loss(rest, posed, nodes, neighbours)
    variable = torch.tensor(posed, requires_grad=True)
    expected = reference_loss(torch.from_numpy(rest), variable, nodes, neighbours)
    expected.backward()
    assert value == pytest.approx(float(expected.detach()), rel=1e-5)
    np.testing.assert_allclose(grad, variable.grad, atol=1e-6)


def test_rigid_motion_costs_nothing():
    rng = np.random.default_rng(1)
    rest = rng.normal(size=(30, 3))
    posed = (rest @ Rotation.from_rotvec([1.0, 2.0, 0.5]).as_matrix().T + 4.0)[None]
    neighbours = np.stack([rng.choice(30, 5, replace=False) for _ in range(30)])
    assert arap_loss(rest, posed, np.arange(30), neighbours)[0] < 1e-10
