# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.skinning.fields.pyramid import SparsePyramid
from gskin_addon.core.skinning.subset import choose_subset, inclusion
from tests.helpers.limb import make_limb


def test_subset_spreads_what_it_learned():
    limb = make_limb(3000)
    subset = choose_subset(limb.cloud, seed=0, limit=1000)
    assert abs(subset.cloud.count - 1000) <= 1
    flat = np.full_like(limb.weights, 1 / 3)
    learned = limb.weights[subset.index]
    extended = subset.to_all_splats(learned, flat[subset.index], flat)
    np.testing.assert_array_equal(extended[subset.index], learned)
    np.testing.assert_allclose(extended.sum(1), 1, atol=1e-5)
    assert np.abs(extended - limb.weights).sum(1).mean() < 0.05  # uniform weights are off by 1.3


def test_small_clouds_are_taken_whole_and_keep_their_order():
    limb = make_limb(500)
    subset = choose_subset(limb.cloud, seed=0)
    assert sorted(subset.index) == list(range(500))
    np.testing.assert_array_equal(subset.cloud.means, limb.cloud.means[subset.index])
    np.testing.assert_array_equal(subset.cloud.scales, limb.cloud.scales[subset.index])
    learned = limb.weights[subset.index]
    np.testing.assert_array_equal(subset.to_all_splats(learned, learned, limb.weights), limb.weights)


def test_the_field_is_asked_before_the_neighbours():
    limb = make_limb(3000)
    subset = choose_subset(limb.cloud, seed=0, limit=1000)
    flat = np.full_like(limb.weights, 1 / 3)
    field = SparsePyramid(subset.cloud.means, flat[subset.index])
    asked = []

    def query(points):
        logits, known = field.query(points)
        asked.append(known)
        return logits + (5.0, 0.0, 0.0), known  # as if the field had learned that the first bone holds all

    learned = limb.weights[subset.index]
    extended = subset.to_all_splats(learned, flat[subset.index], flat, query)
    others = np.setdiff1d(np.arange(3000), subset.index)
    known = np.concatenate(asked)
    assert known.mean() > 0.3
    assert (extended[others][known][:, 0] > 0.9).all()
    assert np.abs(extended - limb.weights)[others][~known].sum(1).mean() < 0.05 or known.all()


def test_large_and_visible_splats_stand_for_the_rest():
    limb = make_limb(3000)
    scales = limb.cloud.scales.copy()
    scales[:300] *= 4
    cloud = replace(limb.cloud, scales=scales)
    visible = np.arange(3000) % 2 == 0
    subset = choose_subset(cloud, seed=0, limit=1000, visible=lambda: visible)
    taken = np.zeros(3000, bool)
    taken[subset.index] = True
    assert taken[:300].mean() > 1.5 * taken[300:].mean()
    assert taken[visible].mean() > 2 * taken[~visible].mean()
    area = np.sort(cloud.scales.astype(float), axis=1)[:, 1:].prod(1)
    covered = np.sort(subset.cloud.scales.astype(float), axis=1)[:, 1:].prod(1)
    assert covered.sum() == pytest.approx(area.sum(), rel=0.15)


def test_inclusion_is_in_proportion_and_certain_for_the_largest():
    value = np.array([1.0, 1.0, 2.0, 100.0, 50.0])
    np.testing.assert_allclose(inclusion(value, 3), [0.25, 0.25, 0.5, 1.0, 1.0])
