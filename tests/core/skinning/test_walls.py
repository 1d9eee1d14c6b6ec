# SPDX-License-Identifier: GPL-3.0-or-later
"""Walls: labelled parts that touch do not take each other's weights, and all else is as without them."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.gaps import bridge_pieces
from gskin_addon.core.skinning.geodesic import body_distances
from gskin_addon.core.skinning.initial import initial_weights_geodesic, initial_with_confidence
from gskin_addon.core.skinning.learned.parts import find_parts
from gskin_addon.core.skinning.node_graph import build_graph
from gskin_addon.core.skinning.subset import follow_nearest
from gskin_addon.core.skinning.voxels import voxelize
from gskin_addon.core.skinning.walls import blocked, nearest_open
from gskin_addon.core.splats.cloud import SplatCloud

METHODS = ("learned", "heat", "geodesic")


def as_cloud(points, colors=None):
    count = len(points)
    return SplatCloud(
        np.asarray(points, np.float32), np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), 0.004, np.float32), np.full(count, 0.9, np.float32),
        np.zeros((count, 1, 3), np.float32) if colors is None else colors,
    )  # fmt: skip


def weights_of(name, cloud, skeleton, walls=None):
    return initial_with_confidence(name, cloud, skeleton, np.zeros((0, 4, 4), bool), [], walls=walls)[0]


def capsule(start, end, radius, count, rng):
    start, end = np.asarray(start, float), np.asarray(end, float)
    centre = start + rng.random((count, 1)) * (end - start)
    away = rng.normal(size=(count, 3))
    caps = rng.random(count) < 2 * radius / (np.linalg.norm(end - start) + 2 * radius)
    axis = (end - start) / np.linalg.norm(end - start)
    along = away @ axis
    away[~caps] -= along[~caps, None] * axis
    centre[caps] = np.where((along[caps] > 0)[:, None], end, start)
    return centre + radius * away / np.linalg.norm(away, axis=1, keepdims=True)


def two_boxes(count=6000):
    """One on the other, without splats between; label 1 is the lower, 2 the upper; each has a bone."""
    rng = np.random.default_rng(0)
    u = rng.random((count, 3))
    u[np.arange(count), rng.integers(0, 3, count)] = rng.integers(0, 2, count)
    points = u * [1, 0.4, 0.8]
    skeleton = Skeleton(
        ("lower", "upper"), np.array([-1, 0]),
        np.array([[0.1, 0.2, 0.2], [0.1, 0.2, 0.6]]), np.array([[0.9, 0.2, 0.2], [0.9, 0.2, 0.6]]),
    )  # fmt: skip
    return as_cloud(points), skeleton, np.where(points[:, 2] < 0.4, 1, 2)


def arm_on_trunk(count=15000):
    """A forearm that lies on the trunk and is fused to it, an upper arm that leads from the trunk's top around to it.

    Labels: 1 the forearm, 2 the trunk but for its top, 0 the rest.
    """
    rng = np.random.default_rng(1)
    bones = {
        "trunk": ((0, 0, 0), (0, 0, 1.0), 0.2), "shoulder": ((0, 0, 1.0), (0.5, 0, 1.0), 0.07),
        "upper": ((0.5, 0, 1.0), (0.5, 0, 0.6), 0.07), "fore": ((0.5, 0, 0.6), (0.26, 0, 0.3), 0.07),
    }  # fmt: skip
    sizes = [count * 6 // 10, *[count * 4 // 30] * 3]
    points = np.concatenate([capsule(*shape, size, rng) for shape, size in zip(bones.values(), sizes, strict=True)])
    part = np.repeat(np.arange(4), sizes)
    for number, (start, end, radius) in enumerate(bones.values()):  # nothing lies inside another part
        axis = np.subtract(end, start)
        t = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
        inside = np.linalg.norm(points - start - t[:, None] * axis, axis=1) < radius - 1e-9
        keep = ~inside | (part == number)
        points, part = points[keep], part[keep]
    heads = np.array([bone[0] for bone in bones.values()], float)
    tails = np.array([bone[1] for bone in bones.values()], float)
    skeleton = Skeleton(tuple(bones), np.array([-1, 0, 1, 2]), heads, tails)
    walls = np.select([part == 3, (part == 0) & (points[:, 2] < 0.8)], [1, 2], 0)
    return as_cloud(points), skeleton, walls, part


@pytest.mark.parametrize("name", METHODS)
def test_touching_boxes_are_kept_apart(name):
    cloud, skeleton, walls = two_boxes()
    leaking, kept = weights_of(name, cloud, skeleton), weights_of(name, cloud, skeleton, walls)
    seam = np.abs(cloud.means[:, 2] - 0.4) < 0.03
    other = np.where(walls == 1, 1, 0)
    across = [weights[np.arange(len(walls)), other][seam].mean() for weights in (leaking, kept)]
    assert across[0] > 0.3  # at the seam each box had about as much of the other's bone
    assert across[1] < 0.02
    np.testing.assert_allclose(kept.sum(axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("name", METHODS)
def test_a_forearm_on_a_trunk_has_nothing_of_it(name):
    cloud, skeleton, walls, part = arm_on_trunk()
    leaking, kept = weights_of(name, cloud, skeleton), weights_of(name, cloud, skeleton, walls)
    near = (part == 3) & (np.linalg.norm(cloud.means[:, :2], axis=1) < 0.24)  # at the seam
    beside = (part == 0) & (np.linalg.norm(cloud.means - [0.2, 0, 0.25], axis=1) < 0.12)
    assert min(near.sum(), beside.sum()) > 50
    assert max(leaking[near, 0].max(), leaking[beside, 3].max()) > 0.5
    assert kept[near, 0].max() < 0.01
    assert kept[beside, 3].max() < 0.01
    np.testing.assert_allclose(kept.sum(axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("name", METHODS)
def test_labels_without_a_wall_change_nothing(name):
    cloud, skeleton, _, _ = arm_on_trunk(4000)
    plain = weights_of(name, cloud, skeleton)
    for walls in (np.zeros(cloud.count, int), np.full(cloud.count, 3)):
        np.testing.assert_array_equal(weights_of(name, cloud, skeleton, walls), plain)


def test_distances_go_around_a_wall():
    cloud, skeleton, walls, part = arm_on_trunk()
    plain, around = body_distances(cloud, skeleton), body_distances(cloud, skeleton, walls=walls)
    hand = (part == 3) & (np.linalg.norm(cloud.means[:, :2], axis=1) < 0.24)
    assert plain[hand, 0].max() < 0.4  # straight into the trunk
    assert around[hand, 0].min() > 0.9  # up the arm and over the shoulder
    assert np.isfinite(around).all()
    assert (around >= plain - 2e-3).all()
    assert (around[hand, 3] <= plain[hand, 3] + 0.05).all()


def test_a_part_with_walls_all_around_is_bridged_all_the_same():
    """Both boxes are labelled throughout: there is no way around, and still all distances are finite."""
    cloud, skeleton, walls = two_boxes()
    assert np.isfinite(body_distances(cloud, skeleton, walls=walls)).all()
    weights = initial_weights_geodesic(cloud.means, cloud.opacities, skeleton, walls=walls)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)


def test_voxels_have_the_label_of_most_of_their_labelled_splats():
    points = np.repeat(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0.0]]), 5, axis=0)
    points += np.random.default_rng(0).uniform(0, 1e-3, points.shape)
    walls = np.array([1, 1, 1, 2, 2] + [0, 0, 0, 0, 7] + [0] * 5 + [2] * 5)
    grid = voxelize(points, np.ones(20), 8, walls=walls)
    labels = [int(grid.walls[tuple(grid.index(points[row]))]) for row in (0, 5, 10, 15)]
    assert labels == [1, 7, 0, 2]
    assert (grid.walls[~grid.solid] == 0).all()
    # Inside, the nearest voxel with splats decides.
    cloud, _, walls = two_boxes()
    grid = voxelize(cloud.means, cloud.opacities, 32, walls=walls)
    assert grid.walls[tuple(grid.index(np.array([0.5, 0.2, 0.3])))] == 1
    assert grid.walls[tuple(grid.index(np.array([0.5, 0.2, 0.5])))] == 2


def test_graphs_and_parts_have_no_links_across():
    cloud, skeleton, walls, _ = arm_on_trunk()
    distances = body_distances(cloud, skeleton)  # which know nothing of the walls
    graph = build_graph(cloud.means, distances, 1500, walls=walls)
    a, b = walls[graph.nodes[graph.edges]].T
    assert not blocked(a, b).any()
    plain = build_graph(cloud.means, distances, 1500)
    assert blocked(*walls[plain.nodes[plain.edges]].T).any()
    crossing = blocked(walls[:, None], walls[graph.nodes[graph.anchor]])
    assert (graph.anchor_weight[crossing] == 0).all()
    np.testing.assert_allclose(graph.anchor_weight.sum(axis=1), 1)
    parts = find_parts(cloud.means.astype(float), cloud.base_colors(), distances, walls=walls)
    for near in parts.near:
        assert not blocked(walls[:, None], walls[near]).any()


def test_splats_beyond_follow_their_own_side():
    means = np.array([[0, 0, 0], [1, 0, 0], [0.9, 0, 0], [0.9, 0, 0.1], [0.9, 0, 0.2]], np.float32)
    ignored = np.array([False, False, True, True, True])
    weights = np.eye(5, dtype=np.float32)
    got = follow_nearest(means, weights.copy(), ignored, np.array([1, 2, 1, 0, 3]))
    assert got.argmax(axis=1).tolist() == [0, 1, 0, 1, 1]  # the last has no side of its own
    assert follow_nearest(means, weights.copy(), ignored).argmax(axis=1).tolist() == [0, 1, 1, 1, 1]


def test_gaps_are_bridged_where_no_wall_is():
    """Three pieces in a row: the shortest gap of the first is across a wall, so it is joined to the last."""
    points = np.array([[0, 0, 0], [0.5, 0, 0], [2, 0, 0], [2.5, 0, 0], [4, 0, 0], [4.5, 0, 0.0]])
    piece = np.array([5, 5, 9, 9, 2, 2])
    assert bridge_pieces(points, piece).tolist() == [[1, 2], [3, 4]]
    assert bridge_pieces(points, piece, np.array([1, 1, 2, 2, 0, 0])).tolist() == [[1, 4], [3, 4]]
    # Nothing else is left: across the wall, and only at its shortest.
    beside = bridge_pieces(points[:4], piece[:4], np.array([1, 1, 2, 2]), beside=9.0)
    assert beside.tolist() == [[1, 2]]
    assert bridge_pieces(points, piece, np.array([1, 1, 2, 2, 2, 2])).tolist() == [[1, 2], [3, 4]]
    assert bridge_pieces(points, np.zeros(6, int)).shape == (0, 2)
    wide = bridge_pieces(np.concatenate([points[:4], points[:4] + [0, 1, 0]]), np.repeat([0, 1], 4), beside=0.6)
    assert wide.tolist() == [[0, 4], [1, 5], [2, 6], [3, 7]]


def test_many_pieces_become_one_by_their_shortest_gaps():
    """Against the minimum spanning tree of the pieces."""
    from scipy.sparse.csgraph import minimum_spanning_tree

    rng = np.random.default_rng(3)
    points, piece = rng.random((300, 3)), rng.integers(0, 40, 300)
    edges = bridge_pieces(points, piece)
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    every = np.linalg.norm(points[:, None] - points, axis=2)
    gaps = np.array([[every[np.ix_(piece == a, piece == b)].min() for b in range(40)] for a in range(40)])
    assert len(edges) == 39
    assert lengths.sum() == pytest.approx(minimum_spanning_tree(gaps).sum())


def test_the_nearest_that_no_wall_hides():
    points, labels = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([1, 2, 0])
    way, index = nearest_open(points, np.array([[0.9, 0, 0]] * 4), labels, np.array([0, 1, 2, 3]))
    assert index.tolist() == [1, 0, 1, 2]
    np.testing.assert_allclose(way, [0.1, 0.9, 0.1, 1.1])
    assert nearest_open(points[:1], points[1:2], labels[:1], np.array([2]))[1].tolist() == [0]
