# SPDX-License-Identifier: GPL-3.0-or-later
"""Conjugate gradients against scipy's factorisation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from gskin_addon.core.errors import Cancelled
from gskin_addon.core.skinning.laplacian import GraphLaplacian


def problem(count=400, columns=7, seed=0):
    rng = np.random.default_rng(seed)
    edges = np.unique(np.sort(rng.integers(0, count, (5 * count, 2)), axis=1), axis=0)
    edges = edges[edges[:, 0] < edges[:, 1]]
    edges = np.concatenate([edges, np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)])
    edges = np.unique(edges, axis=0)
    diagonal = np.where(rng.random(count) < 0.3, 10.0 ** rng.uniform(-2, 4, count), 0)
    return edges, diagonal, diagonal[:, None] * rng.dirichlet(np.ones(columns), count)


def exact(edges, diagonal, right):
    a, b = edges.T
    one_way = sparse.coo_matrix((np.ones(len(a)), (a, b)), (len(diagonal),) * 2)
    adjacency = one_way + one_way.T
    return splu((sparse.diags(np.asarray(adjacency.sum(1)).ravel() + diagonal) - adjacency).tocsc()).solve(right)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_solutions_are_those_of_a_factorisation(seed):
    edges, diagonal, right = problem(seed=seed)
    right[:, 3] = 0
    expected = exact(edges, diagonal, right)
    system = GraphLaplacian(len(diagonal), edges)
    np.testing.assert_allclose(system.solve(diagonal, right), expected, atol=2e-5)
    # From a guess, and from the solution itself.
    np.testing.assert_allclose(system.solve(diagonal, right, expected + 0.1), expected, atol=2e-5)
    np.testing.assert_array_equal(system.solve(diagonal, right, expected), expected)


def test_heat_of_all_bones_is_one_everywhere():
    edges, diagonal, right = problem(1000, 5)
    np.testing.assert_allclose(GraphLaplacian(1000, edges).solve(diagonal, right).sum(axis=1), 1, atol=1e-4)


def test_one_node_alone_and_a_stop():
    lone = GraphLaplacian(1, np.zeros((0, 2), int))
    np.testing.assert_allclose(lone.solve(np.array([2.0]), np.array([[4.0, 1.0]])), [[2.0, 0.5]])

    def stop(done):
        raise Cancelled

    edges, diagonal, right = problem()
    with pytest.raises(Cancelled):
        GraphLaplacian(len(diagonal), edges).solve(diagonal, right, tick=stop)
