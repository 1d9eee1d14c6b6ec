# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from proxy_meshes import tube

from gskin_addon.core.rig.nearest import nearest_triangles
from gskin_addon.core.rig.triangles import closest_barycentric


def brute_distances(points, corner):
    """(N, F): to every triangle, by dense search over its region with projections onto plane, edges, corners."""
    out = np.empty((len(points), len(corner)))
    for n, p in enumerate(points):
        for f, (a, b, c) in enumerate(corner):
            found = [np.linalg.norm(p - q) for q in (a, b, c)]
            for u, v in ((a, b), (b, c), (c, a)):
                d = v - u
                if d @ d > 0:
                    t = (p - u) @ d / (d @ d)
                    if 0 < t < 1:
                        found.append(np.linalg.norm(p - u - t * d))
            normal = np.cross(b - a, c - a)
            if normal @ normal > 1e-20:
                foot = p - (p - a) @ normal / (normal @ normal) * normal
                sides = [np.cross(v - u, foot - u) @ normal for u, v in ((a, b), (b, c), (c, a))]
                if min(sides) >= 0:
                    found.append(np.linalg.norm(p - foot))
            out[n, f] = min(found)
    return out


def foot_points(bary, corner):
    return np.einsum("nk,nkd->nd", bary, corner)


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from([0.0, 0.02, 1.0]))
@settings(max_examples=30, deadline=None)
def test_it_is_the_nearest_of_random_triangles(seed, faces, spread):
    rng = np.random.default_rng(seed)
    corner = rng.normal(size=(faces, 1, 3)) + rng.lognormal(-1, 1.5, (faces, 1, 1)) * rng.normal(size=(faces, 3, 3))
    points = np.concatenate([rng.normal(size=(6, 3)) * 2, corner.reshape(-1, 3)[:4] + spread * rng.normal(size=3)])
    index, bary = nearest_triangles(points, corner)
    assert bary.min() >= 0
    np.testing.assert_allclose(bary.sum(axis=1), 1, atol=1e-12)
    found = np.linalg.norm(points - foot_points(bary, corner[index]), axis=1)
    np.testing.assert_allclose(found, brute_distances(points, corner).min(axis=1), atol=1e-9)


def test_points_equally_far_from_everything():
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    corner = np.stack([ring, np.roll(ring, -1, axis=0), ring + np.array([0.0, 0.0, 1.0])], axis=1)
    points = np.zeros((50, 3)) + np.linspace(0, 1e-3, 50)[:, None]
    index, bary = nearest_triangles(points, corner)
    found = np.linalg.norm(points - foot_points(bary, corner[index]), axis=1)
    np.testing.assert_allclose(found, brute_distances(points, corner).min(axis=1), atol=1e-9)


def test_of_faces_that_share_the_foot_the_one_that_faces_the_point_is_taken():
    verts = np.array([[0, 0, 0], [0, 1, 0], [1, 0.5, 0], [-0.2, 0.5, -1.0]])
    corner = verts[[[0, 2, 1], [0, 1, 3]]]
    above, beside = nearest_triangles(np.array([[-1e-6, 0.5, 0.3], [-0.3, 0.5, 0.01]]), corner)[0]
    assert (above, beside) == (0, 1)


def test_order_of_the_faces_does_not_change_the_distances():
    verts, faces = tube()
    rng = np.random.default_rng(0)
    points = verts[rng.integers(0, len(verts), 500)] + rng.normal(0, 0.05, (500, 3))
    mixed = rng.permutation(len(faces))
    distances = []
    for order in (np.arange(len(faces)), mixed):
        corner = verts[faces[order]]
        index, bary = nearest_triangles(points, corner)
        distances.append(np.linalg.norm(points - foot_points(bary, corner[index]), axis=1))
    np.testing.assert_allclose(*distances, atol=1e-12)


def test_flat_triangles_count_as_segments():
    line = np.array([[[0, 0, 0], [1, 0, 0], [2, 0, 0]]], float)
    point = np.array([[1.5, 1, 0]])
    np.testing.assert_allclose(foot_points(closest_barycentric(point, line), line), [[1.5, 0, 0]], atol=1e-12)
    dot = np.ones((1, 3, 3))
    np.testing.assert_allclose(foot_points(closest_barycentric(point, dot), dot), [[1, 1, 1]])
    with pytest.raises(ValueError, match="no triangles"):
        nearest_triangles(point, np.zeros((0, 3, 3)))
