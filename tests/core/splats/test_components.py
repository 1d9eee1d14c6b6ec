# SPDX-License-Identifier: GPL-3.0-or-later
"""Connected components against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components as scipy_components

from gskin_addon.core.splats.components import connected_components, label_voxels


def check(count, first, second):
    label = connected_components(count, first, second)
    _, expected = scipy_components(coo_matrix((np.ones(len(first)), (first, second)), (count, count)), False)
    smallest = np.full(count, count)
    np.minimum.at(smallest, expected, np.arange(count))
    np.testing.assert_array_equal(label, smallest[expected])


def test_components_are_those_of_scipy():
    rng = np.random.default_rng(3)
    for count in (1, 30, 400):
        check(count, *rng.integers(0, count, (2, int(0.9 * count))))
    chain = rng.permutation(3000)  # a long path in no order
    check(3000, chain[:-1], chain[1:])
    check(5, np.zeros(0, int), np.zeros(0, int))


@pytest.mark.parametrize("share", [0.0, 0.02, 0.1, 0.3, 1.0])
def test_voxels_are_labelled_like_scipy_does(share):
    mask = np.random.default_rng(1).random((30, 25, 28)) < share
    label, count = label_voxels(mask)
    expected, wanted = ndimage.label(mask, np.ones((3, 3, 3)))
    assert count == wanted
    np.testing.assert_array_equal(label > 0, mask)
    assert len(set(zip(label[mask].tolist(), expected[mask].tolist(), strict=True))) == count
    assert set(np.unique(label)) - {0} == set(range(1, count + 1))
