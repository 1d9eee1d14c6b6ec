# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.render.camera import (
    Camera,
    evaluation_views,
    look_at,
    orbit_views,
    paper_views,
    percentile_bounds,
)

LOWER, UPPER = np.array([-0.8, -0.2, 0.0]), np.array([0.8, 0.3, 1.8])


def test_look_at_is_opencv() -> None:
    c = look_at((0, -3, 1), (0, 0, 1), size=64)
    assert np.allclose(c.rotation @ c.rotation.T, np.eye(3))
    assert np.isclose(np.linalg.det(c.rotation), 1)
    assert np.allclose(c.center, (0, -3, 1))
    assert np.allclose(c.forward, (0, 1, 0))
    pixels, depth = c.project([[0, 0, 1], [0.1, 0, 1], [0, 0, 1.1], [0, -4, 1]])
    assert np.allclose(pixels[0], (32, 32))
    assert np.isclose(depth[0], 3)
    assert pixels[1, 0] > 32
    assert np.isclose(pixels[1, 1], 32)
    assert pixels[2, 1] < 32
    assert np.isclose(pixels[2, 0], 32)
    assert np.isnan(pixels[3]).all()
    assert depth[3] < 0


def test_paper_views_stand_where_they_say() -> None:
    front, back, front_left, front_right = paper_views(LOWER, UPPER, 128)
    middle = 0.5 * (LOWER + UPPER)
    assert np.allclose((front.center - middle)[[0, 2]], 0)
    assert front.center[1] < LOWER[1]
    assert back.center[1] > UPPER[1]
    # A character that faces -y has its left at +x.
    assert front_left.center[0] > UPPER[0]
    assert front_left.center[1] < 0
    assert front_right.center[0] < LOWER[0]
    assert front_right.center[1] < 0
    distances = [np.linalg.norm(c.center - middle) for c in (front, back, front_left, front_right)]
    assert np.ptp(distances) < 1e-9


@pytest.mark.parametrize("size", [96, (60, 120), (120, 60)])
@pytest.mark.parametrize("front", [(0, -1, 0), (1, 0.5, 0)])
def test_views_frame_the_box(size: int | tuple[int, int], front: tuple[float, float, float]) -> None:
    corners = np.array(
        [[x, y, z] for x in (LOWER[0], UPPER[0]) for y in (LOWER[1], UPPER[1]) for z in (LOWER[2], UPPER[2])]
    )
    views = evaluation_views(LOWER, UPPER, size, front=front, margin=0.1)
    assert len(views) == 6
    slack = np.inf
    for c in views:
        pixels, depth = c.project(corners)
        free = np.concatenate([pixels / (c.width, c.height), 1 - pixels / (c.width, c.height)])
        assert free.min() > 0.1 - 1e-9
        assert depth.min() > c.near
        slack = min(slack, free.min())
    assert slack < 0.1 + 1e-6  # no farther away than needed


def test_resized_keeps_the_view() -> None:
    c: Camera = orbit_views(LOWER, UPPER, (100, 200), [30.0], elevation=20.0)[0]
    p = np.random.default_rng(0).uniform(LOWER, UPPER, (20, 3))
    small = c.resized(50)
    assert small.size == (25, 50)
    assert np.allclose(c.project(p)[0] / 4, small.project(p)[0])
    assert np.allclose(c.project(p)[0] * (0.5, 2), c.resized((200, 100)).project(p)[0])


def test_percentile_bounds_ignore_floaters() -> None:
    p = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    p[0] = 1e6
    p[1] = np.nan
    lo, hi = percentile_bounds(p)
    assert (lo > -1).all()
    assert (hi < 1).all()
    assert (hi > 0.98).all()


@pytest.mark.parametrize(
    "call",
    [
        lambda: look_at((0, 0, 0), (0, 0, 0), size=8),
        lambda: percentile_bounds(np.zeros((0, 3))),
        lambda: paper_views(UPPER, LOWER, 8),
        lambda: paper_views(LOWER, UPPER, 8, front=(0, 0, 1)),
        lambda: paper_views(LOWER, UPPER, 8, margin=0.5),
    ],
)
def test_unusable_input_is_refused(call: object) -> None:
    with pytest.raises(InputError):
        call()  # type: ignore[operator]


def test_looking_along_up_still_works() -> None:
    c = look_at((0, 0, 5), (0, 0, 0), size=8)
    assert np.allclose(c.rotation @ c.rotation.T, np.eye(3))
    assert np.allclose(c.forward, (0, 0, -1))
