# SPDX-License-Identifier: GPL-3.0-or-later
"""Filters on voxel grids against scipy.ndimage's."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from gskin_addon.core.skinning.voxel_filters import blur, close_holes, dilate, fill_holes, outside, slope_at

BLOCK = np.ones((3, 3, 3), bool)


def noise(share, shape=(24, 19, 21), seed=0):
    return np.random.default_rng(seed).random(shape) < share


def blobs(seed=0):
    rng = np.random.default_rng(seed)
    return ndimage.gaussian_filter(rng.random((26, 22, 24)), 1.2) > 0.5


def test_growing_and_closing():
    for mask in (noise(0.02), noise(0.2), blobs(), np.zeros((4, 5, 6), bool)):
        np.testing.assert_array_equal(dilate(mask), ndimage.binary_dilation(mask, BLOCK))
        np.testing.assert_array_equal(close_holes(mask), ndimage.binary_closing(mask, BLOCK))


def test_holes_are_filled_and_mazes_are_walked():
    for mask in (noise(0.4), noise(0.7, seed=3), blobs(), blobs(5)):
        np.testing.assert_array_equal(fill_holes(mask), ndimage.binary_fill_holes(mask))
    maze = np.zeros((15, 15, 5), bool)
    maze[1:-1, 1:-1, 1:-1] = True
    maze[2:-2, 2, 2] = maze[2, 2:-2, 2] = maze[2:-2, 12, 2] = maze[12, 4:-2, 2] = maze[4:-2, 4, 2] = False
    maze[12, 2, :2] = False
    way_in = ~maze
    np.testing.assert_array_equal(outside(maze), way_in)
    maze[12, 2, 0] = True
    assert outside(maze).sum() < way_in.sum() - 30


def test_the_blur_and_its_slope():
    solid = np.pad(blobs(), 6)
    wanted = ndimage.gaussian_filter(solid.astype(np.float32), 1.0)
    np.testing.assert_allclose(blur(solid), wanted, atol=1e-6)
    places = np.random.default_rng(2).uniform(1, np.array(solid.shape) - 2.01, (500, 3))
    expected = [ndimage.map_coordinates(slope, places.T, order=1) for slope in np.gradient(wanted)]
    np.testing.assert_allclose(slope_at(wanted, places), np.stack(expected, axis=1), atol=1e-6)
    assert np.isfinite(slope_at(wanted, np.array([[-5.0, 0, 99], [0, 0, 0]]))).all()
