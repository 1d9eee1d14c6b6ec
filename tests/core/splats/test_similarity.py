# SPDX-License-Identifier: GPL-3.0-or-later
"""Which map moved a set of points."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.splats.similarity import fit_similarity, is_affine


def rotation(seed):
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("flat", [False, True])
def test_a_similarity_is_found(flat):
    points = np.random.default_rng(0).normal(size=(20, 3))
    if flat:
        points[:, 2] = 0.5
    R = rotation(1)
    found = fit_similarity(points, 2.5 * points @ R.T + [1, 2, 3])
    np.testing.assert_allclose(found.rotation, R, atol=1e-9)
    assert found.scale == pytest.approx(2.5)
    np.testing.assert_allclose(found.translation, [1, 2, 3], atol=1e-9)
    assert found.turns_or_scales
    assert not fit_similarity(points, points + 4).turns_or_scales


@pytest.mark.parametrize("linear", [np.diag([1.0, 2.0, 1.0]), np.diag([-1.0, 1.0, 1.0])])
def test_other_affine_maps_are_told_apart(linear):
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert fit_similarity(points, points @ linear) is None
    assert is_affine(points, points @ linear)


def test_no_single_map():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3))
    moved = points.copy()
    moved[3] += 0.1
    assert fit_similarity(points, moved) is None
    assert not is_affine(points, moved)


def test_too_little_to_tell():
    line = np.arange(10.0)[:, None] * [1.0, 2.0, 3.0]
    assert fit_similarity(line, 2 * line) is None
    assert fit_similarity(line[:2], line[:2]) is None
    assert not is_affine(line[:4], line[:4])
