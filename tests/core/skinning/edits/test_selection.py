# SPDX-License-Identifier: GPL-3.0-or-later
"""Selections by colour, along the body, from a view, and of unsure groups, against what is obvious."""

from __future__ import annotations

import numpy as np

from gskin_addon.core.skinning.edits.body_graph import body_graph
from gskin_addon.core.skinning.edits.selection import (
    alike,
    by_color,
    grown,
    in_front,
    linked,
    oklab,
    pieces,
    shrunk,
    spacing,
    worst_clusters,
)


def line(count, at=0.0):
    return np.stack([np.arange(count) * 0.1, np.full(count, at), np.zeros(count)], axis=1)


def two_lines(count=40):
    return np.concatenate([line(count), line(count, 9.0)])


def test_oklab_of_known_colours():
    # White, black and the primaries as Ottosson's post gives them (to three digits).
    given = [(1, 1, 1), (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    wanted = [(1, 0, 0), (0, 0, 0), (0.628, 0.225, 0.126), (0.866, -0.234, 0.179), (0.452, -0.032, -0.312)]
    np.testing.assert_allclose(oklab(given), wanted, atol=2e-3)


def test_by_color_finds_what_looks_alike():
    colors = np.array([(0.8, 0.1, 0.1), (0.75, 0.12, 0.1), (0.1, 0.1, 0.8), (0.8, 0.5, 0.1)])
    assert by_color(colors, colors[0], 0.05).tolist() == [True, True, False, False]
    assert by_color(colors, colors[0], 2.0).all()
    assert by_color(colors, colors[0], 0.0).tolist() == [True, False, False, False]


def test_grow_and_shrink_go_along_the_body():
    # A hairpin: its ends lie side by side in space, and far from one another along it.
    bend = np.linspace(0, np.pi, 20)
    means = np.concatenate([
        np.stack([np.linspace(0, 2, 60), np.zeros(60), np.zeros(60)], axis=1),
        np.stack([2 + 0.6 * np.sin(bend), 0.6 - 0.6 * np.cos(bend), np.zeros(20)], axis=1)[1:],
        np.stack([np.linspace(2, 0, 60), np.full(60, 1.2), np.zeros(60)], axis=1)[1:],
    ])
    graph = body_graph(means, neighbours=4)
    start = np.zeros(len(means), bool)
    start[0] = True
    found = grown(graph, start, 1.3)
    assert found[:30].all()
    assert not found[50:].any(), "the other end is 1.2 away through the air"
    back = shrunk(graph, found, 0.5)
    assert back[0]
    assert 0 < back.sum() < found.sum()
    assert not (back & ~found).any()
    assert np.array_equal(shrunk(graph, np.ones(len(means), bool), 9.0), np.ones(len(means), bool))
    np.testing.assert_allclose(spacing(body_graph(line(30))), 0.1, rtol=1e-5)


def test_linked_ends_at_gaps_and_walls():
    means = two_lines()
    graph = body_graph(means, neighbours=3)
    start = np.zeros(80, bool)
    start[5] = True
    assert linked(graph, start).tolist() == [True] * 40 + [False] * 40
    walls = np.zeros(80, int)
    walls[15:20], walls[20:25] = 1, 2
    start[5] = True
    assert linked(body_graph(means, neighbours=3, walls=walls), start).sum() == 20
    labels = pieces(graph, np.arange(80) % 40 < 10)
    assert set(labels[:10]) == {labels[0]}
    assert set(labels[40:50]) == {labels[40]} != {labels[0]}
    assert (labels[10:40] == -1).all()


def test_worst_clusters_come_first_and_crumbs_not_at_all():
    means = two_lines()
    confidence = np.full(80, 0.9)
    confidence[3:9], confidence[50:62], confidence[75] = 0.1, 0.3, 0.0
    found = worst_clusters(body_graph(means, neighbours=3), confidence, 19 / 80)
    assert [rows.tolist() for rows in found] == [list(range(50, 62)), list(range(3, 9))]
    assert worst_clusters(body_graph(means, neighbours=3), confidence, 0.0) == []


def test_alike_is_the_share_in_common():
    index = np.array([[0, 1], [1, 2], [2, 0], [0, 0]])
    value = np.array([[0.7, 0.3], [0.5, 0.5], [1.0, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(alike(index, value, np.array([0.7, 0.3, 0.0])), [1.0, 0.3, 0.0, 0.7], atol=1e-6)


def test_in_front_of_a_sphere():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(20_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    view = np.eye(4)
    view[2, 3] = -5.0  # from +z
    near, far = 0.1, 100.0
    perspective = np.diag([2.0, 2.0, -(far + near) / (far - near), 0.0])
    perspective[2, 3], perspective[3, 2] = -2 * far * near / (far - near), -1.0
    orthographic = np.diag([0.5, 0.5, -0.02, 1.0])
    for lens, horizon in ((perspective, 0.2), (orthographic, 0.0)):
        seen = in_front(points, view, lens, 0.06)
        assert seen[points[:, 2] > horizon + 0.15].mean() > 0.99
        assert seen[points[:, 2] < horizon - 0.2].mean() < 0.02, "but for the very rim"
    # Blender's view with parallel rays has what it turns about at depth 0, not what lies before all.
    seen = in_front(points, np.eye(4), orthographic, 0.06)
    assert np.array_equal(seen, in_front(points, view, orthographic, 0.06))
    behind = view.copy()
    behind[2, 3] = 5.0
    assert not in_front(points, behind, perspective, 0.05).any()
