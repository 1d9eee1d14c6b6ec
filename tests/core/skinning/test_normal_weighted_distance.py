# SPDX-License-Identifier: GPL-3.0-or-later
"""Normals that point outwards, and distances that count them."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.rig.segments import bone_segments
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.normal_weighted_distance import (
    consistent_normals,
    normal_weighted_distances,
    outward_normals,
    surface_normals,
)
from gskin_addon.core.skinning.voxels import voxelize


def ball(count=4000, seed=0):
    """Points on a unit sphere, a tenth of them a little below it."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points * np.where(rng.random(count) < 0.1, 0.97, 1.0)[:, None]


def test_normals_of_a_closed_body_point_outwards():
    points = ball()
    normals = surface_normals(points)
    out = outward_normals(points, normals, voxelize(points, np.ones(len(points)), 48))
    radial = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.median((out * radial).sum(1)) > 0.97
    assert ((out * radial).sum(1) > 0.5).mean() > 0.99
    flipped = outward_normals(points, -normals, voxelize(points, np.ones(len(points)), 48))
    np.testing.assert_allclose(flipped, out, atol=1e-9)  # whichever way the normals pointed


def test_a_leaf_has_no_outside():
    """A sheet beside a ball: its normals are not trusted, those of the ball are."""
    rng = np.random.default_rng(1)
    sheet = np.column_stack([rng.uniform(1.5, 3.5, 3000), rng.uniform(-1, 1, 3000), rng.normal(0, 1e-3, 3000)])
    points = np.concatenate([ball(), sheet])
    out = outward_normals(points, surface_normals(points), voxelize(points, np.ones(len(points)), 48))
    inner = (np.abs(sheet[:, 0] - 2.5) < 0.8) & (np.abs(sheet[:, 1]) < 0.8)
    sure = np.linalg.norm(out, axis=1)
    assert np.median(sure[:4000]) == pytest.approx(1.0)
    assert np.median(sure[4000:][inner]) < 0.5


def test_the_two_sides_of_cloth_disagree_and_those_of_a_finger_do_not():
    """A curtain far from its bone, and a finger of the same thickness around its own."""
    rng = np.random.default_rng(3)
    side = np.where(rng.random(4000) < 0.5, 1.0, -1.0)
    cloth = np.column_stack([rng.uniform(-1, 1, 4000), 0.01 * side, rng.uniform(-1, 1, 4000)])
    angle = rng.uniform(0, 2 * np.pi, 4000)
    finger = np.column_stack([3 + 0.03 * np.cos(angle), 0.03 * np.sin(angle), rng.uniform(-1, 1, 4000)])
    points = np.concatenate([cloth, finger])
    out = np.zeros((8000, 3))
    out[:4000, 1] = side
    out[4000:, 0], out[4000:, 1] = np.cos(angle), np.sin(angle)
    nearest = np.repeat([0.5, 0.03], 4000)
    got = consistent_normals(points, out, nearest, 4.0)
    inner = np.abs(points[:, 2]) < 0.9
    kept = np.linalg.norm(got, axis=1)
    assert np.median(kept[:4000][inner[:4000]]) < 0.5
    assert np.median(kept[4000:][inner[4000:]]) > 0.9
    assert ((got * out).sum(1) >= 0).all()
    assert (kept <= 1 + 1e-9).all()


def test_distances_match_a_plain_loop_and_prefer_the_bone_behind():
    rng = np.random.default_rng(2)
    skeleton = Skeleton(
        ("root", "left", "right"), np.array([-1, 0, 0]),
        np.array([[0, 0, 0], [-1, 0, 0.0], [1, 0, 0]]), np.array([[0, 0, 0.1], [-1, 0, 2.0], [1, 0, 2]]),
    )  # fmt: skip
    segments = bone_segments(skeleton)
    points, out = rng.normal(size=(40, 3)), rng.normal(size=(40, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    ways = rng.uniform(0.0, 2, (40, len(segments.bone))).astype(np.float32)
    got = normal_weighted_distances(points, out, segments, ways, 0.05)
    assert got.shape == (40, 3)
    for n in range(40):
        best = np.full(3, np.inf)
        for s in range(len(segments.bone)):
            axis = segments.ends[s] - segments.starts[s]
            t = np.clip((points[n] - segments.starts[s]) @ axis / (axis @ axis), 0, 1)
            way = points[n] - segments.starts[s] - t * axis
            cosine = way @ out[n] / np.linalg.norm(way)
            far = max(float(ways[n, s]), 0.05) / ((cosine + 1.001) / 2)
            best[segments.bone[s]] = min(best[segments.bone[s]], far)
        np.testing.assert_allclose(got[n], best, rtol=1e-5)
    # Halfway between two legs, on the inner side of the left one: the left leg is nearer.
    middle = normal_weighted_distances(
        np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]]), segments, np.ones((1, len(segments.bone)), np.float32), 0.0
    )[0]
    assert middle[1] == pytest.approx(1.0, rel=1e-2)
    assert middle[2] > 100
