# SPDX-License-Identifier: GPL-3.0-or-later
"""A click finds the object that is seen there."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.render.camera import look_at
from gskin_addon.core.render.drawn_splats import DrawnSplats
from gskin_addon.core.render.picking import pick as pick_with_depth
from gskin_addon.core.render.screen_space import camera_matrices, project

SIZE = (120, 160)
VIEW, PERSPECTIVE = camera_matrices(look_at((0, -4, 0), (0, 0, 0), size=SIZE))
PARALLEL = np.diag([0.5, 0.5 * SIZE[1] / SIZE[0], -0.02, 1.0])


def pick(*arguments):
    found = pick_with_depth(*arguments)
    return None if found is None else found[0]


def ball(place, opacity: float = 0.9, count: int = 300, seed: int = 0, matrix=None) -> DrawnSplats:
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3))
    points = 0.3 * points / np.linalg.norm(points, axis=1, keepdims=True) + place
    return DrawnSplats(
        points.astype(np.float32), random.normal(size=(count, 4)).astype(np.float32),
        np.full((count, 3), (0.05, 0.04, 0.02), np.float32), np.full(count, opacity, np.float32),
        np.zeros((count, 1, 3), np.float32), matrix=matrix,
    )  # fmt: skip


def pixel_of(place, projection):
    point = np.asarray(place, np.float64)[None] @ VIEW[:3, :3].T + VIEW[:3, 3]
    return project(point, projection, SIZE)[0][0]


@pytest.mark.parametrize("projection", [PERSPECTIVE, PARALLEL], ids=["perspective", "orthographic"])
def test_the_object_under_the_pixel(projection):
    left, right = ball((-0.6, 0, 0)), ball((0.6, 0, 0), seed=1)
    for number, place in ((0, (-0.6, 0, 0)), (1, (0.6, 0, 0))):
        assert pick([left, right], VIEW, projection, SIZE, pixel_of(place, projection)) == number
    assert pick([left, right], VIEW, projection, SIZE, pixel_of((0, 0, 0), projection)) is None
    assert pick([left, right], VIEW, projection, SIZE, (1, 1)) is None


@pytest.mark.parametrize("projection", [PERSPECTIVE, PARALLEL], ids=["perspective", "orthographic"])
def test_the_nearer_object_hides_the_farther_one(projection):
    near, far, faint = ball((0, -1, 0)), ball((0, 1, 0), seed=1), ball((0, -1.5, 0), 0.01, seed=2)
    at = pixel_of((0, 0, 0), projection)
    assert pick([near, far], VIEW, projection, SIZE, at) == 0
    assert pick([far, near], VIEW, projection, SIZE, at) == 1
    assert pick([faint, far], VIEW, projection, SIZE, at) == 1, "one can see through faint splats"
    assert pick([faint], VIEW, projection, SIZE, at) is None


def test_the_depth_is_that_of_the_surface():
    for projection in (PERSPECTIVE, PARALLEL):
        _, depth = pick_with_depth([ball((0, 0, 0))], VIEW, projection, SIZE, pixel_of((0, 0, 0), projection))
        assert depth == pytest.approx(3.7, abs=0.1)


def test_objects_are_where_their_matrices_put_them():
    moved = np.diag([2.0, 2.0, 2.0, 1.0])
    moved[:3, 3] = (0.8, 0, 0)
    splats = ball((0, 0, 0), matrix=moved)
    assert pick([splats], VIEW, PERSPECTIVE, SIZE, pixel_of((1.2, 0, 0), PERSPECTIVE)) == 0
    assert pick([splats], VIEW, PERSPECTIVE, SIZE, pixel_of((0, 0, 0), PERSPECTIVE)) is None
    assert pick([], VIEW, PERSPECTIVE, SIZE, (80, 60)) is None
