# SPDX-License-Identifier: GPL-3.0-or-later
"""The fabric: where it is, where it is not, and which side it faces."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.skinning.fabric import Fabric, fabric_triangles
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.components import connected_components


def ball(count: int, centre=(0, 0, 0), radius: float = 1.0, seed: int = 0):
    """Points evenly on a ball, a little shaken."""
    rng = np.random.default_rng(seed)
    i = np.arange(count) + 0.5
    height, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - height**2)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    points += rng.normal(0, 0.1 / np.sqrt(count), points.shape)
    return points / np.linalg.norm(points, axis=1, keepdims=True) * radius + centre


def cloud_of(points):
    count = len(points)
    return SplatCloud(
        means=points.astype(np.float32),
        quats=np.tile([1, 0, 0, 0], (count, 1)).astype(np.float32),
        scales=np.full((count, 3), 0.02, np.float32),
        opacities=np.ones(count, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


def test_a_ball_is_covered_and_faces_out():
    points = ball(2000)
    triangles = fabric_triangles(cloud_of(points))
    corner = points[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    outward = (normal * corner.mean(axis=1)).sum(axis=1) > 0
    assert outward.mean() > 0.995
    assert len(np.unique(np.sort(triangles, axis=1), axis=0)) == len(triangles)
    assert (np.diff(np.sort(triangles, axis=1), axis=1) > 0).all()
    assert len(np.unique(triangles)) == 2000, "every splat is in it"
    # Covered: from the middle every direction meets a triangle.
    ways = ball(500, seed=5)
    edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    for way in ways:
        p = np.cross(way, edge2)
        det = (edge1 * p).sum(axis=1)
        u = -(corner[:, 0] * p).sum(axis=1) / det
        q = np.cross(-corner[:, 0], edge1)
        v, t = (q * way).sum(axis=1) / det, (q * edge2).sum(axis=1) / det
        assert ((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0)).any()


def test_a_fabric_knows_its_edges():
    triangles = fabric_triangles(cloud_of(ball(300)))
    fabric = Fabric.of(triangles)
    expected = {tuple(sorted(pair)) for t in triangles.tolist() for pair in zip(t, t[1:] + t[:1], strict=True)}
    assert {tuple(edge) for edge in fabric.edges.tolist()} == expected
    assert len(fabric.edges) == len(expected)
    corners = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)
    assert np.array_equal(fabric.edges[fabric.sides], np.sort(corners, axis=2))


def edges_of(triangles):
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def test_no_triangle_crosses_a_gap_a_wall_or_far_bones():
    points = np.concatenate([ball(1000), ball(1000, (2.5, 0, 0), seed=1)])
    pieces = connected_components(2000, *edges_of(fabric_triangles(cloud_of(points))).T)
    assert len(np.unique(pieces[:1000])) == len(np.unique(pieces[1000:])) == 1
    assert pieces[0] != pieces[1000]

    touching = np.concatenate([ball(1000), ball(1000, (2.0, 0, 0), seed=1)])
    side = np.repeat([0, 1], 1000)
    free = edges_of(fabric_triangles(cloud_of(touching)))
    assert (side[free[:, 0]] != side[free[:, 1]]).any()
    walled = edges_of(fabric_triangles(cloud_of(touching), walls=side + 1))
    assert (side[walled[:, 0]] == side[walled[:, 1]]).all()
    far = np.array([[False, True], [True, False]])
    apart = edges_of(fabric_triangles(cloud_of(touching), apart=(side, far)))
    assert (side[apart[:, 0]] == side[apart[:, 1]]).all()


def test_splats_on_one_another_make_no_thread():
    points = ball(300)
    points = np.concatenate([points, points[:50]])
    triangles = fabric_triangles(cloud_of(points))
    corner = points[triangles]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        assert np.linalg.norm(corner[:, i] - corner[:, j], axis=1).min() > 0


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_few_splats(count):
    triangles = fabric_triangles(cloud_of(ball(count) if count > 1 else np.zeros((1, 3))))
    assert triangles.shape[1] == 3
    assert len(triangles) == 0 or triangles.max() < count
