# SPDX-License-Identifier: GPL-3.0-or-later
"""Filters on voxel grids (X, Y, Z) in numpy alone; everything outside a grid counts as empty."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def dilate(mask: Array) -> Array:
    """mask grown by one voxel over its 26 neighbours."""
    out = mask.copy()
    for axis in range(3):
        before = out.copy()
        _along(out, axis)[1:] |= _along(before, axis)[:-1]
        _along(out, axis)[:-1] |= _along(before, axis)[1:]
    return out


def close_holes(mask: Array) -> Array:
    """mask grown by one voxel and shrunk again: cracks of up to two voxels are filled."""
    out: Array = ~dilate(~dilate(mask))
    for axis in range(3):  # beyond the grid is empty
        _along(out, axis)[[0, -1]] = False
    return out


def outside(solid: Array) -> Array:
    """Voxels that are not solid and are connected to the border of the grid over the 6 neighbours. Sweeps in the six
    directions, until a round finds nothing new.
    """
    free = ~solid
    out = np.zeros_like(free)
    for axis in range(3):
        _along(out, axis)[[0, -1]] = _along(free, axis)[[0, -1]]
    done = -1
    while (reached := int(np.count_nonzero(out))) != done:
        done = reached
        for axis in range(3):
            # Sweeps go along the first axis of a copy with contiguous planes: strided ones are slow.
            planes, way = np.ascontiguousarray(_along(out, axis)), np.ascontiguousarray(_along(free, axis))
            step = np.empty_like(planes[0])
            for i in range(1, len(planes)):
                planes[i] |= np.logical_and(planes[i - 1], way[i], out=step)
            for i in range(len(planes) - 2, -1, -1):
                planes[i] |= np.logical_and(planes[i + 1], way[i], out=step)
            _along(out, axis)[...] = planes
    return out


def fill_holes(solid: Array) -> Array:
    """solid, and everything that it encloses."""
    return ~outside(solid)


def blur(solid: Array, deviation: float = 1.0) -> Array:
    """Gaussian of `deviation` voxels over solid, float32, cut off at four deviations."""
    reach = math.ceil(4 * deviation)
    kernel = np.exp(-0.5 * np.square(np.arange(reach + 1) / deviation))
    kernel = (kernel / (2 * kernel.sum() - kernel[0])).astype(np.float32)
    out = solid.astype(np.float32)
    for axis in range(3):
        source = out
        out = kernel[0] * source
        part = np.empty_like(source)
        for k in range(1, reach + 1):
            np.multiply(source, kernel[k], out=part)
            _along(out, axis)[k:] += _along(part, axis)[:-k]
            _along(out, axis)[:-k] += _along(part, axis)[k:]
    return out


def slope_at(field: Array, places: Array) -> Array:
    """Gradient (N, 3) of field by central differences, trilinear between voxels, at places (N, 3): voxel (i, j, k)
    lies at (i, j, k); positions beyond the inner voxels are clamped to them."""
    size = np.array(field.shape)
    places = np.clip(places, 1, np.maximum(size - 2, 1))
    cell = np.minimum(places.astype(np.int64), np.maximum(size - 3, 1))
    part = places - cell
    stride = np.array([size[1] * size[2], size[2], 1])
    base = cell @ stride
    flat, out = field.ravel(), np.zeros((len(places), 3))
    for corner in np.ndindex(2, 2, 2):
        share = np.where(corner, part, 1 - part).prod(axis=1)
        at = base + int(stride @ corner)
        for axis in range(3):
            far = np.minimum(at + stride[axis], len(flat) - 1)
            out[:, axis] += share * (flat[far] - flat[at - stride[axis]]) / 2
    return out


def _along(grid: Array, axis: int) -> Array:
    """The grid with `axis` first, a view."""
    return np.moveaxis(grid, axis, 0)
