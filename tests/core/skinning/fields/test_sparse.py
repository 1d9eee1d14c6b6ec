# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.ndimage import map_coordinates

from gskin_addon.core.skinning.fields.sparse import SparseProduct, trilinear_matrix, unit_cube


@pytest.mark.parametrize("columns", [1, 3, 8, 20, 61])
def test_product_and_its_gradient(columns):
    rng = np.random.default_rng(0)
    matrix = sparse.random(40, 25, 0.2, random_state=1)
    dense = torch.from_numpy(rng.normal(size=(25, columns)).astype(np.float32)).requires_grad_()
    pull = rng.normal(size=(40, columns)).astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = SparseProduct(matrix)(dense)
        (found * torch.from_numpy(pull)).sum().backward()
    np.testing.assert_allclose(found.detach(), matrix @ dense.detach().numpy(), atol=1e-5)
    np.testing.assert_allclose(dense.grad, matrix.T @ pull, atol=1e-5)


def test_rows_and_columns_without_entries():
    product = SparseProduct(sparse.csr_matrix(([2.0], ([1], [2])), shape=(3, 4)))
    dense = torch.ones(4, 2, requires_grad=True)
    found = product(dense)
    found.sum().backward()
    assert found.tolist() == [[0, 0], [2, 2], [0, 0]]
    assert dense.grad.tolist() == [[0, 0], [0, 0], [2, 2], [0, 0]]


def test_interpolation_is_trilinear():
    """A dense grid sampled by scipy, and by torch's grid_sample, against the matrix."""
    rng = np.random.default_rng(1)
    unit = unit_cube(rng.uniform(-1, 1, (400, 3)))
    matrix, at = trilinear_matrix(unit, 9)
    assert matrix.shape == (400, len(at))
    dense = rng.normal(size=(9, 9, 9))
    found = matrix @ dense[tuple(at.T)]
    np.testing.assert_allclose(found, map_coordinates(dense, unit.T * 8, order=1), atol=1e-9)
    sampled = torch.nn.functional.grid_sample(
        torch.from_numpy(dense.T.copy())[None, None],  # grid_sample wants z, y, x and places as x, y, z
        torch.from_numpy(unit * 2 - 1)[None, None, None],
        align_corners=True,
    )
    np.testing.assert_allclose(found, sampled.ravel(), atol=1e-9)


def test_the_cube_is_centred_and_strays_do_not_stretch_it():
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (5000, 3)) * (4, 1, 1) + 7
    unit = unit_cube(np.concatenate([points, [[1e4, 7, 7], [7, -1e4, 7]]]))
    assert unit[:-2].min(0) == pytest.approx([0, 0.375, 0.375], abs=0.02)
    assert unit[:-2].max(0) == pytest.approx([1, 0.625, 0.625], abs=0.02)
    assert unit[-2, 0] == 1
    assert unit[-1, 1] == 0
