# SPDX-License-Identifier: GPL-3.0-or-later
"""A solid voxel model of a splat object, whose splats only cover its surface."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..rig.nearest_points import nearest_points
from ..rig.quaternion import quat_to_matrix
from ..splats.components import label_voxels
from ..ticks import Tick, silent
from .extent import robust_bounds
from .voxel_filters import close_holes, dilate, fill_holes, outside

Array = NDArray[Any]

_PAD = 3  # empty voxels on every side, so that the outside is connected
_OFFSETS = [(a, b) for a, b in itertools.product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=2) if a * a + b * b <= 1]
"""Along the two longer axes of a large splat, in standard deviations, where it covers voxels."""

_ENCLOSED = 23  # of 26 directions: a voxel shut in this far is inside, in spite of holes


@dataclasses.dataclass(frozen=True)
class VoxelGrid:
    """Cubic voxels over an object.

    solid: (X, Y, Z) bool, surface and interior. shell: (X, Y, Z) bool, voxels that splats reach. origin: (3,)
    world position of the outer corner of voxel (0, 0, 0). pitch: edge of a voxel in metres. walls: (X, Y, Z) int32
    labels of the solid voxels, see `voxelize`, or None.
    """

    solid: Array
    shell: Array
    origin: Array
    pitch: float
    walls: Array | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y, z."""
        return self.solid.shape  # type: ignore[return-value]

    def coordinates(self, points: Array) -> Array:
        """World points (..., 3) in voxel units: voxel (i, j, k) spans i..i+1, its centre is i + 0.5."""
        return (np.asarray(points, dtype=np.float64) - self.origin) / self.pitch

    def index(self, points: Array) -> Array:
        """The voxel (..., 3) int of world points, moved to the nearest one in the grid."""
        index = np.floor(self.coordinates(points)).astype(np.int64)
        return np.clip(index, 0, np.array(self.shape) - 1)

    def centers(self, index: Array) -> Array:
        """World positions (..., 3) of the centres of voxels (..., 3)."""
        return (np.asarray(index) + 0.5) * self.pitch + self.origin


def voxelize(
    means: Array,
    opacities: Array,
    resolution: int = 96,
    *,
    scales: Array | None = None,
    quats: Array | None = None,
    faint: float = 0.1,
    walls: Array | None = None,
    tick: Tick = silent,
) -> VoxelGrid:
    """Fill the object that splats cover.

    Voxels with splats form a shell; its small holes are closed, what the outside cannot reach is filled, and
    so is what lies enclosed in nearly all directions (a shell with a hole, such as a capture's foot soles).
    Splats fainter than `faint` and small clusters away from the body do not count.

    means (N, 3), opacities (N,); `scales` (N, 3) and `quats` (N, 4) let large splats cover the voxels they
    reach. `resolution`: voxels along the longest side; fewer where the splats are too sparse for them. walls (N,):
    labels, 0 for none; a voxel has the one that most of its labelled splats have, and one without splats that of the
    nearest with some. Raises InputError when fewer than two splats are left.
    """
    means = np.asarray(means, dtype=np.float64)
    seen = np.asarray(opacities) >= faint
    if seen.sum() < 2:
        seen = np.ones(len(means), dtype=bool)
    if len(means) < 2:
        raise InputError(f"{len(means)} splats have no shape; initial weights need at least two splats.")
    tick(0.0)
    low, high = robust_bounds(means[seen])
    tick(0.1)
    seen &= ((means >= low) & (means <= high)).all(axis=1)
    points = means[seen]
    longest = float((high - low).max()) or 1.0
    pitch = max(longest / resolution, min(_spacing(points), longest / 8))
    origin = (low + high) / 2 - (np.ceil((high - low) / pitch) / 2 + _PAD) * pitch
    shape = np.ceil((high - low) / pitch).astype(np.int64) + 2 * _PAD + 1
    shell = np.zeros(shape, dtype=bool)
    places: Iterable[Array] = [points]
    if scales is not None and quats is not None:
        places = itertools.chain(places, _spread(points, scales[seen], quats[seen], pitch))
    tick(0.2)
    for number, place in enumerate(places):
        tick(0.25 + 0.3 * number / (1 + len(_OFFSETS)))
        index = np.floor((place - origin) / pitch).astype(np.int64)
        index = index[((index >= 0) & (index < shape)).all(axis=1)]
        shell[tuple(index.T)] = True
    shell = _without_specks(shell)
    tick(0.6)
    grid = VoxelGrid(_filled(shell), shell, origin, pitch)
    tick(0.9)
    if walls is not None:
        labels = _voxel_walls(grid, points, np.asarray(walls)[seen])
        grid = dataclasses.replace(grid, walls=labels)
    return grid


def _voxel_walls(grid: VoxelGrid, points: Array, walls: Array) -> Array:
    """(X, Y, Z) int32 labels of the solid voxels from those of the splats at points (N, 3)."""
    voxel = np.ravel_multi_index(tuple(grid.index(points).T), grid.shape)
    inside = grid.solid.ravel()[voxel]
    voxel, label = voxel[inside], np.asarray(walls, np.int64)[inside]
    pair, count = np.unique(np.stack([voxel, label], axis=1), axis=0, return_counts=True)
    order = np.lexsort((pair[:, 1], count * (pair[:, 1] != 0), pair[:, 0]))  # the most frequent label comes last
    pair = pair[order]
    pair = pair[np.append(pair[1:, 0] != pair[:-1, 0], True)] if len(pair) else pair
    out = np.zeros(grid.solid.size, np.int32)
    out[pair[:, 0]] = pair[:, 1]
    empty = grid.solid.ravel().copy()
    empty[pair[:, 0]] = False
    rest = np.flatnonzero(empty)
    if len(pair) and len(rest):
        centres = (np.column_stack(np.unravel_index(at, grid.shape)) for at in (pair[:, 0], rest))
        out[rest] = pair[nearest_points(next(centres), next(centres), 1)[1][:, 0], 1]
    return out.reshape(grid.shape)


def _spacing(points: Array) -> float:
    """A voxel edge at which a surface sampled by `points` has few holes (seeded subset, 4th neighbour)."""
    probe = points
    if len(points) > 4000:
        probe = points[np.random.default_rng(0).choice(len(points), 4000, replace=False)]
    k = min(5, len(points))
    return float(np.percentile(nearest_points(points, probe, k)[0][:, -1], 75))


def _spread(points: Array, scales: Array, quats: Array, pitch: float) -> Iterator[Array]:
    """Points on the two longer axes of each splat that is larger than half a voxel, up to one standard
    deviation.

    Very large splats count as six voxels: huge ones are more often background haze than surface.
    """
    large = np.sort(scales, axis=1)[:, 1] > 0.5 * pitch
    points = points[large]
    scale = np.minimum(np.asarray(scales[large], dtype=np.float64), 3 * pitch)
    axes = quat_to_matrix(np.asarray(quats[large], dtype=np.float64)) * scale[:, None, :]
    order = np.argsort(-scale, axis=1)[:, :2]
    first = np.take_along_axis(axes, order[:, None, :1], axis=2)[..., 0]
    second = np.take_along_axis(axes, order[:, None, 1:], axis=2)[..., 0]
    del axes
    for a, b in _OFFSETS:
        yield points + (a * first + b * second)


def _without_specks(shell: Array) -> Array:
    """The shell without clusters of less than a thousandth of its voxels: strays, not parts."""
    label, count = label_voxels(shell)
    size = np.bincount(label.ravel(), minlength=count + 1)
    size[0] = 0
    keep = size >= max(2.0, 1e-3 * size.sum())
    if size[keep].sum() < 0.5 * size.sum():  # all in crumbs: a sparse object, not strays
        return shell
    return keep[label]


def _filled(shell: Array) -> Array:
    closed = close_holes(shell)
    inside = ~closed & (~outside(closed) | (enclosure(closed) >= _ENCLOSED))
    # Of what the closing added, only the lining of the inside is kept, so that narrow gaps stay open.
    solid = shell | inside | (closed & dilate(inside))
    # Limbs too thin for the closing to leave an inside are filled by the looks of the shell itself.
    solid |= enclosure(solid) >= _ENCLOSED
    return fill_holes(solid)


def enclosure(solid: Array) -> Array:
    """In how many of the 26 directions to its neighbours each voxel (X, Y, Z) meets a solid one, uint8.

    One sweep per direction: a voxel is blocked where its neighbour is solid or blocked itself.
    """
    votes = np.zeros(solid.shape, dtype=np.uint8)
    for direction in itertools.product((-1, 0, 1), repeat=3):
        if direction == (0, 0, 0):
            continue
        axis = next(a for a in range(3) if direction[a] != 0)
        grid = np.moveaxis(solid, axis, 0)
        rest = [direction[a] for a in range(3) if a != axis]
        hit = np.moveaxis(np.zeros_like(solid), axis, 0)
        slices = range(len(grid) - 2, -1, -1) if direction[axis] > 0 else range(1, len(grid))
        for i in slices:
            neighbour = i + direction[axis]
            hit[i] = _shifted(grid[neighbour] | hit[neighbour], rest[0], rest[1])
        votes += np.moveaxis(hit, 0, axis)
    return votes


def _shifted(plane: Array, di: int, dj: int) -> Array:
    """out[i, j] = plane[i + di, j + dj], False beyond the edge."""
    if di == 0 and dj == 0:
        return plane
    out = np.zeros_like(plane)
    n, m = plane.shape
    target = (slice(max(0, -di), n - max(0, di)), slice(max(0, -dj), m - max(0, dj)))
    source = (slice(max(0, di), n - max(0, -di)), slice(max(0, dj), m - max(0, -dj)))
    out[target] = plane[source]
    return out
