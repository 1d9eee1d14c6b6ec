# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes of weights against slow references."""

from __future__ import annotations

import heapq

import numpy as np
import pytest

from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.edits.assign import flood, limit, normalise, to_bone
from gskin_addon.core.skinning.edits.blend import follow_neighbours, sharpen, smooth
from gskin_addon.core.skinning.edits.body_graph import along_body, body_graph, grow
from gskin_addon.core.skinning.edits.keep import keep
from gskin_addon.core.skinning.edits.mirror import mirror


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def some_weights(rng, count, bones):
    weights = rng.random((count, bones)) ** 3
    weights[rng.random(weights.shape) < 0.4] = 0
    weights[:, 0] += 1e-3
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def blobs(rng):
    """Two bodies side by side, and a splat on top of another."""
    first = rng.random((150, 3))
    second = rng.random((100, 3)) + [3, 0, 0]
    return np.concatenate([first, second, first[:1]])


def test_graph_has_the_nearest_and_no_gap(rng):
    means = blobs(rng)
    graph = body_graph(means, neighbours=6)
    way = np.linalg.norm(means[:, None] - means[None], axis=2)
    np.fill_diagonal(way, np.inf)
    expected = np.sort(way, axis=1)[:, :6]
    assert np.allclose(np.where(graph.linked, graph.length, expected), expected, atol=1e-6)
    assert graph.linked.mean() > 0.95
    side = means[:, 0] > 2
    assert (side[graph.neighbour] == side[:, None]).all()
    assert not (graph.neighbour == np.arange(len(means))[:, None])[graph.linked].any()


def test_walls_cut_the_graph(rng):
    means = rng.random((200, 3))
    walls = np.where(means[:, 0] > 0.5, 2, 1)
    walls[means[:, 0] > 0.9] = 0
    graph = body_graph(means, walls=walls)
    a, b = walls[:, None], walls[graph.neighbour]
    assert not ((a != b) & (a != 0) & (b != 0)).any()


def test_ways_along_the_body_are_dijkstras(rng):
    means = blobs(rng)
    graph = body_graph(means, neighbours=5)
    seeds = np.zeros(len(means), bool)
    seeds[[4, 90, 200]] = True
    edges = {}
    for source in range(len(means)):
        for target, length in zip(graph.neighbour[source], graph.length[source], strict=True):
            if np.isfinite(length):
                edges.setdefault(source, []).append((int(target), float(length)))
                edges.setdefault(int(target), []).append((source, float(length)))
    expected = np.full(len(means), np.inf)
    queue = [(0.0, int(seed)) for seed in np.flatnonzero(seeds)]
    while queue:
        way, at = heapq.heappop(queue)
        if way < expected[at]:
            expected[at] = way
            for target, length in edges.get(at, []):
                heapq.heappush(queue, (way + length, target))
    expected[expected > 0.6] = np.inf
    assert np.allclose(along_body(graph, seeds, 0.6), expected, atol=1e-5)


def test_grow_and_shrink(rng):
    means = rng.random((300, 3))
    graph = body_graph(means, neighbours=4)
    selected = means[:, 0] < 0.3
    expected = selected.copy()
    for source in range(300):
        for target in graph.neighbour[source][graph.linked[source]]:
            expected[target] |= selected[source]
            expected[source] |= selected[target]
    assert np.array_equal(grow(graph, selected), expected)
    assert np.array_equal(grow(graph, ~selected, -2), ~grow(graph, selected, 2))
    assert grow(graph, selected, 3).sum() > grow(graph, selected).sum()


def test_what_is_kept_is_kept_to_the_bit(rng):
    before, after = some_weights(rng, 60, 5), some_weights(rng, 60, 5) * 3
    selected = rng.random(60) < 0.5
    locked = np.array([False, True, False, True, False])
    out = keep(before, after, selected=selected, locked=locked)
    assert np.array_equal(out[~selected], before[~selected])
    assert np.array_equal(out[:, locked], before[:, locked])
    assert np.allclose(out.sum(axis=1), 1, atol=1e-6)
    changed = selected & (before[:, locked].sum(axis=1) < 1)
    row = np.flatnonzero(changed)[0]
    open_ = after[row, ~locked] / after[row, ~locked].sum() * (1 - before[row, locked].sum())
    assert np.allclose(out[row, ~locked], open_, atol=1e-6)


def test_no_more_bones_than_wanted(rng):
    before, after = some_weights(rng, 60, 6), some_weights(rng, 60, 6)
    locked = np.array([True, False, False, False, False, False])
    out = keep(before, after, locked=locked, most=3)
    assert np.array_equal(out[:, 0], before[:, 0])
    changed = (out != before).any(axis=1)
    assert (np.count_nonzero(out[changed], axis=1) <= 3).all()
    for row in np.flatnonzero(changed):
        room = 3 - int(before[row, 0] > 0)
        strongest = np.sort(after[row, 1:])[::-1][:room]
        share = strongest / strongest.sum() * (1 - before[row, 0])
        assert np.allclose(np.sort(out[row, 1:])[::-1][:room], share, atol=1e-6)


def test_a_row_that_would_be_empty_stays():
    before = np.array([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0]], np.float32)
    after = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]], np.float32)
    assert np.array_equal(keep(before, after, locked=np.array([True, False, False])), before)


def test_smooth_is_the_step_to_the_mean(rng):
    means, weights = blobs(rng), some_weights(rng, 251, 4)
    graph = body_graph(means, neighbours=5)
    selected = rng.random(251) < 0.5
    expected = weights.astype(np.float64)
    for _ in range(3):
        now = expected.copy()
        for row in np.flatnonzero(selected):
            beside = graph.neighbour[row][graph.linked[row]]
            if len(beside):
                expected[row] = 0.3 * now[row] + 0.7 * now[beside].mean(axis=0)
    out = smooth(weights, graph, selected=selected, factor=0.7, repeat=3)
    assert np.allclose(out, expected, atol=1e-5)
    assert np.array_equal(out[~selected], weights[~selected])
    assert np.allclose(out.sum(axis=1), 1, atol=1e-5)


def test_sharpen(rng):
    weights = some_weights(rng, 50, 4)
    assert np.allclose(sharpen(weights, 0), weights, atol=1e-6)
    hard = sharpen(weights, 1)
    assert np.array_equal(hard.argmax(axis=1), weights.argmax(axis=1))
    assert np.allclose(hard.max(axis=1), 1)
    half = weights**2 / (weights**2).sum(axis=1, keepdims=True)
    assert np.allclose(sharpen(weights, 0.5), half, atol=1e-6)


def test_followers_have_the_mean_of_their_neighbours(rng):
    means, weights = blobs(rng), some_weights(rng, 251, 3)
    graph = body_graph(means, neighbours=5)
    selected = np.linalg.norm(means - [0.5, 0.5, 0.5], axis=1) < 0.45
    selected |= means[:, 0] > 2  # a whole body that nothing holds
    out, alone = follow_neighbours(weights, graph, selected)
    assert np.array_equal(alone, means[:, 0] > 2)
    assert np.array_equal(out[~selected | alone], weights[~selected | alone])
    links = np.zeros((251, 251), bool)
    links[np.repeat(np.arange(251), 5), graph.neighbour.ravel()] = graph.linked.ravel()
    links |= links.T
    for row in np.flatnonzero(selected & ~alone):
        assert np.allclose(out[row], out[links[row]].mean(axis=0), atol=1e-4)


def test_to_bone_with_and_without_a_rim(rng):
    means, weights = rng.random((400, 3)), some_weights(rng, 400, 3)
    selected = means[:, 0] < 0.3
    hard = to_bone(weights, 2, selected)
    assert np.array_equal(hard[~selected], weights[~selected])
    assert (hard[selected] == [0, 0, 1]).all()
    graph = body_graph(means)
    soft = to_bone(weights, 2, selected, rim=0.4, graph=graph)
    assert (soft[selected] == [0, 0, 1]).all()
    way = along_body(graph, selected, 0.4)
    assert np.array_equal(soft[np.isinf(way)], weights[np.isinf(way)])
    between = (way > 0) & np.isfinite(way)
    assert between.any()
    share = (soft[between, 2] - weights[between, 2]) / (1 - weights[between, 2])
    t = 1 - way[between] / 0.4
    assert np.allclose(share, 3 * t**2 - 2 * t**3, atol=1e-4)
    assert np.allclose(soft.sum(axis=1), 1, atol=1e-5)


def test_flood_and_limit(rng):
    weights = some_weights(rng, 40, 5)
    selected = rng.random(40) < 0.5
    out = flood(weights, 1, 0.25, selected)
    assert np.array_equal(out[~selected], weights[~selected])
    others = np.delete(weights[selected], 1, axis=1)
    rest = others / others.sum(axis=1, keepdims=True)
    assert np.allclose(np.delete(out[selected], 1, axis=1), 0.75 * rest, atol=1e-6)
    assert np.allclose(out[selected, 1], 0.25)
    alone = np.array([[0, 1.0]], np.float32)
    assert np.array_equal(flood(alone, 1, 0.2, np.array([True])), alone)
    few = limit(weights, 2)
    assert (np.count_nonzero(few, axis=1) <= 2).all()
    assert np.allclose(few.max(axis=1), np.sort(weights)[:, -1] / np.sort(weights)[:, -2:].sum(axis=1), atol=1e-6)
    assert np.allclose(normalise(3 * weights), weights, atol=1e-6)
    assert (normalise(np.zeros((2, 3))) == 0).all()


def test_mirror_gives_each_side_the_others_weights(rng):
    half = rng.random((500, 3)) * [1, 0.3, 2]
    means = np.concatenate([half, half * [-1, 1, 1] + rng.normal(0, 1e-4, half.shape)])
    skeleton = Skeleton(
        ("spine", "arm.L", "arm.R"),
        np.array([-1, 0, 0]),
        np.array([[0, 0, 0], [0.2, 0, 1], [-0.2, 0, 1.0]]),
        np.array([[0, 0, 2], [1, 0, 1], [-1, 0, 1.0]]),
    )
    weights = np.zeros((1000, 3), np.float32)
    weights[:500, 1] = np.clip(half[:, 0] * 2, 0, 1)
    weights[:500, 0] = 1 - weights[:500, 1]
    weights[500:, 0] = 1
    means = np.concatenate([means, [[-9.0, 0, 0]]])
    weights = np.concatenate([weights, [[1, 0, 0]]]).astype(np.float32)
    out, alone = mirror(weights, means, skeleton)
    assert np.flatnonzero(alone).tolist() == [1000]
    assert np.array_equal(out[:500], weights[:500])
    assert np.abs(out[500:1000, 2] - weights[:500, 1]).max() < 0.02
    assert (out[500:, 1] == 0).all()
    back, _ = mirror(out, means, skeleton, source="right")
    assert np.abs(back[:500] - weights[:500]).max() < 0.02
    only, _ = mirror(weights, means, skeleton, selected=means[:, 2] > 1)
    assert np.array_equal(only[means[:, 2] <= 1], weights[means[:, 2] <= 1])


def test_rows_that_a_tool_leaves_alone_stay_to_the_bit():
    before = np.random.default_rng(5).random((200, 6)).astype(np.float32)  # sums unlike 1, and six bones
    after = before.copy()
    after[::2, 1] += 1
    out = keep(before, after, locked=np.array([True, *[False] * 5]), most=4)
    assert np.array_equal(out[1::2], before[1::2])
    assert (out[::2] != before[::2]).any(axis=1).all()
