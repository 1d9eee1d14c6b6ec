# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np

from gskin_addon.core.skinning.subset import choose_subset
from tests.helpers.limb import make_limb


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


def test_small_clouds_are_taken_whole_and_keep_their_order():
    limb = make_limb(500)
    subset = choose_subset(limb.cloud, seed=0)
    assert sorted(subset.index) == list(range(500))
    np.testing.assert_array_equal(subset.cloud.means, limb.cloud.means[subset.index])
    np.testing.assert_array_equal(subset.cloud.scales, limb.cloud.scales[subset.index])
    learned = limb.weights[subset.index]
    np.testing.assert_array_equal(subset.spread(learned, learned, limb.weights), limb.weights)
