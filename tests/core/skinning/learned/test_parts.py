# SPDX-License-Identifier: GPL-3.0-or-later
"""Neighbours, touching pieces and colour regions."""

from __future__ import annotations

import numpy as np

from gskin_addon.core.skinning.learned.parts import apart, even_subset, find_parts, label_means


def plates(rng, gap=0.3):
    """Two square plates above each other, the lower one half red and half blue, the upper one green."""
    points = np.column_stack([rng.random((1600, 2)), np.repeat([0.0, gap], 800)])
    colors = np.tile([0.1, 0.8, 0.1], (1600, 1))
    colors[:800] = np.where(points[:800, :1] < 0.5, [0.9, 0.1, 0.1], [0.1, 0.1, 0.9])
    return points, colors


def test_pieces_and_colours_are_found():
    rng = np.random.default_rng(0)
    points, colors = plates(rng)
    profile = points[:, 2:] * 50 + np.zeros((1, 2))  # the way from plate to plate is far longer than the gap
    parts = find_parts(points, colors + rng.normal(0, 0.01, colors.shape), profile)
    truth = np.where(points[:, 2] > 0, 2, points[:, 0] >= 0.5)
    piece, tight, loose = parts.labels.T
    assert set(np.bincount(piece)) == {800}
    for label in (tight, loose):
        # Never two true regions in one label, and nearly every splat in the label of its region.
        assert all(len(set(truth[label == one])) == 1 for one in np.unique(label))
        for region in range(3):
            assert np.bincount(label[truth == region]).max() > 0.9 * (truth == region).sum()


def test_neighbourhoods_do_not_reach_across_a_gap():
    rng = np.random.default_rng(1)
    points, colors = plates(rng, gap=0.02)
    points = points[rng.permutation(1600)]
    profile = points[:, 2:] * 50
    for near in find_parts(points, colors, profile).near:
        assert (points[near][:, :, 2] == points[:, None, 2]).mean() > 0.97
        assert np.linalg.norm(points[near] - points[:, None], axis=-1).max() < 0.6


def test_apart_matches_its_definition():
    rng = np.random.default_rng(2)
    profile, index, way = rng.random((40, 5)), rng.integers(0, 40, (40, 3)), rng.random((40, 3))
    found = apart(index.astype(np.int32), way, profile)
    pitch = np.median(way)
    for n in range(40):
        for k in range(3):
            jump = np.abs(profile[n] - profile[index[n, k]]).max()
            assert found[n, k] == (jump > 2 * max(way[n, k], pitch))


def test_pooling_is_a_mean_and_subsets_are_even():
    rng = np.random.default_rng(3)
    label, values = rng.integers(0, 4, 100), rng.random((100, 3)).astype(np.float32)
    expected = np.stack([values[label == k].mean(axis=0) for k in range(4)])
    np.testing.assert_allclose(label_means(values, label), expected, rtol=1e-5)
    points = rng.random((4000, 3)) * [1, 1, 0] + np.where(rng.random((4000, 1)) < 0.9, 0, [0.0, 0, 2])
    chosen = even_subset(points, 500)
    assert 450 < len(chosen) < 550
    upper = points[chosen][:, 2] > 1
    assert 0.4 < upper.mean() < 0.6  # the sparse plate has as many as the dense one
