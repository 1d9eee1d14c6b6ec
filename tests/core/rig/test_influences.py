# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.rig.influences import Influences
from gskin_addon.core.rig.lbs import sparsify


@pytest.fixture
def weights():
    return np.random.default_rng(0).dirichlet(np.ones(7), 50).astype(np.float32)


def test_the_strongest_are_those_of_sparse_weights(weights):
    np.testing.assert_allclose(Influences.strongest(weights).dense(7), sparsify(weights, 4), atol=1e-6)
    np.testing.assert_allclose(Influences.strongest(weights[:, :2]).dense(2).sum(axis=1), 1, atol=1e-6)


def test_an_empty_slot_takes_nothing_away():
    given = Influences(np.array([[3, 3]], np.int32), np.array([[1.0, 0.0]], np.float32))
    assert given.dense(5).tolist() == [[0, 0, 0, 1, 0]]


def test_parts_and_rows(weights):
    whole = Influences.strongest(weights)
    joined = Influences.joined([Influences.strongest(weights[:20]), Influences.strongest(weights[20:])])
    np.testing.assert_array_equal(joined.index, whole.index)
    np.testing.assert_array_equal(joined.value, whole.value)
    np.testing.assert_array_equal(whole.rows(np.array([4, 4])).index, whole.index[[4, 4]])


def test_faults_are_said(weights):
    good = Influences.strongest(weights)
    assert good.fault(50, 7) == ""
    assert "splats" in good.fault(49, 7)
    assert "bones outside" in good.fault(50, 3)
    assert "negative" in Influences(good.index, -good.value).fault(50, 7)
    assert "sum to 1" in Influences(good.index, good.value * 2).fault(50, 7)
    assert "arrays of" in Influences(good.index, good.index).fault(50, 7)
    assert "for 50 splats" in Influences(good.index[:, :2], good.value).fault(50, 7)
