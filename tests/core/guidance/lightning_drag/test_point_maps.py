# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance.control import ControlSignal
from gskin_addon.core.guidance.lightning_drag.point_maps import check_size, farthest_points, point_facts, point_maps
from gskin_addon.core.render.camera import look_at


def test_points_are_single_numbered_pixels():
    handles = np.array([[2.0, 5.9], [10.5, 0.0]])
    targets = np.array([[3.99, 6.0], [63.9, 63.2]])
    maps = point_maps(handles, targets, 64, 128)
    assert maps.shape == (2, 64, 128)
    assert {tuple(p): maps[tuple(p)] for p in np.argwhere(maps)} == {
        (0, 5, 2): 1,
        (0, 0, 10): 2,
        (1, 6, 3): 1,
        (1, 63, 63): 2,
    }


def test_later_points_overwrite_and_points_outside_are_dropped_in_pairs():
    handles = np.array([[5.0, 5.0], [20.0, 20.0], [5.2, 5.7], [np.nan, 1.0]])
    targets = np.array([[1.0, 1.0], [64.0, 3.0], [9.0, 9.0], [3.0, 3.0]])
    maps = point_maps(handles, targets, 64, 64)
    assert maps[0, 5, 5] == 2
    assert maps[0].sum() == 2
    assert maps[1, 1, 1] == 1
    assert maps[1, 9, 9] == 2
    assert maps[1].sum() == 3


def test_no_points_are_empty_maps():
    assert not point_maps(np.zeros((0, 2)), np.zeros((0, 2)), 64, 64).any()


@pytest.mark.parametrize("size", [(100, 64), (64, 63), (0, 64)])
def test_sides_are_multiples_of_64(size):
    with pytest.raises(InputError, match="multiples of 64"):
        check_size(*size)
    check_size(512, 448)


def test_dense_points_are_thinned_by_their_distance():
    rng = np.random.default_rng(0)
    cluster = rng.normal(30, 0.5, (40, 2))
    far = np.array([[400.0, 30], [30, 400], [400, 400]])
    handles = np.concatenate([cluster[:20], far, cluster[20:]])
    kept, targets = farthest_points(handles, handles + (0, 3), 5)
    assert len(kept) == len(targets) == 5
    assert {tuple(p) for p in far} <= {tuple(p) for p in kept}
    np.testing.assert_array_equal(targets, kept + (0, 3))
    order = [np.flatnonzero((handles == p).all(1))[0] for p in kept]
    assert order == sorted(order)
    assert farthest_points(handles, handles, 0)[0] is handles


def test_thinning_keeps_the_point_that_moves_most_and_joints_that_part():
    handles = np.full((6, 2), 50.0)
    targets = handles + np.array([[1, 0], [0, 1], [30, 0], [1, 1], [0, 25], [2, 2]])
    _, kept = farthest_points(handles, targets, 2)
    np.testing.assert_array_equal(kept, targets[[2, 4]])


def test_points_that_the_model_is_not_shown_are_counted():
    camera = look_at((0, -1, 0), (0, 0, 0), size=(64, 64))

    def signal(count, outside=0):
        handles = np.linspace([5.0, 5], [60, 60], count) if count else np.zeros((0, 2))
        targets = handles + (1, 2)
        targets[:outside, 0] = -4
        return ControlSignal(0, camera, np.zeros((0, 4, 4)), handles, targets)

    signals = [signal(3), signal(25), signal(20, 2), signal(22), signal(0)]
    expected = {"limit": 20, "images": 5, "images_over": 2, "points": 70, "dropped": 7, "outside": 2}
    assert point_facts(signals, 20) == expected
    for one, most in ((signals[1], 20), (signals[2], 20)):
        shown = point_maps(*farthest_points(one.handles, one.targets, most), 64, 64)
        counted = point_facts([one], most)
        assert (shown[0] > 0).sum() == counted["points"] - counted["dropped"] - counted["outside"]
    assert point_facts(signals, 0)["dropped"] == 0
