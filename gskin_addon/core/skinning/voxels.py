# SPDX-License-Identifier: GPL-3.0-or-later
"""A solid voxel model of a splat object, whose splats only cover its surface."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..rig.quaternion import quat_to_matrix
from .extent import robust_bounds

Array = NDArray[Any]

_PAD = 3  # empty voxels on every side, so that the outside is connected
_ENCLOSED = 23  # of 26 directions: a voxel shut in this far is inside, in spite of holes


@dataclasses.dataclass(frozen=True)
class VoxelGrid:
    """Cubic voxels over an object.

    solid: (X, Y, Z) bool, surface and interior. shell: (X, Y, Z) bool, voxels that splats reach. origin: (3,)
    world position of the outer corner of voxel (0, 0, 0). pitch: edge of a voxel in metres.
    """

    solid: Array
    shell: Array
    origin: Array
    pitch: float

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
) -> VoxelGrid:
    """Fill the object that splats cover.

    Voxels with splats form a shell; its small holes are closed, what the outside cannot reach is filled, and
    so is what lies enclosed in nearly all directions (a shell with a hole, such as a capture's foot soles).
    Splats fainter than `faint` and small clusters away from the body do not count.

    means (N, 3), opacities (N,); `scales` (N, 3) and `quats` (N, 4) let large splats cover the voxels they
    reach. `resolution`: voxels along the longest side; fewer where the splats are too sparse for them. Raises
    InputError when fewer than two splats are left.
    """
    means = np.asarray(means, dtype=np.float64)
    seen = np.asarray(opacities) >= faint
    if seen.sum() < 2:
        seen = np.ones(len(means), dtype=bool)
    if len(means) < 2:
        raise InputError(f"{len(means)} splats have no shape; initial weights need at least two splats.")
    low, high = robust_bounds(means[seen])
    seen &= ((means >= low) & (means <= high)).all(axis=1)
    points = means[seen]
    longest = float((high - low).max()) or 1.0
    pitch = max(longest / resolution, min(_spacing(points), longest / 8))
    origin = (low + high) / 2 - (np.ceil((high - low) / pitch) / 2 + _PAD) * pitch
    shape = np.ceil((high - low) / pitch).astype(np.int64) + 2 * _PAD + 1
    if scales is not None and quats is not None:
        points = np.concatenate([points, _spread(points, scales[seen], quats[seen], pitch)])
    index = np.floor((points - origin) / pitch).astype(np.int64)
    index = index[((index >= 0) & (index < shape)).all(axis=1)]
    shell = np.zeros(shape, dtype=bool)
    shell[tuple(index.T)] = True
    shell = _without_specks(shell)
    return VoxelGrid(_filled(shell), shell, origin, pitch)


def _spacing(points: Array) -> float:
    """A voxel edge at which a surface sampled by `points` has few holes (seeded subset, 4th neighbour)."""
    from scipy.spatial import cKDTree

    probe = points
    if len(points) > 4000:
        probe = points[np.random.default_rng(0).choice(len(points), 4000, replace=False)]
    k = min(5, len(points))
    distance = cKDTree(points).query(probe, k=k)[0][:, -1]
    return float(np.percentile(distance, 75))


def _spread(points: Array, scales: Array, quats: Array, pitch: float) -> Array:
    """Points on the two longer axes of each splat that is larger than half a voxel, up to one standard
    deviation.

    Very large splats count as six voxels: huge ones are more often background haze than surface.
    """
    large = np.sort(scales, axis=1)[:, 1] > 0.5 * pitch
    scale = np.minimum(np.asarray(scales[large], dtype=np.float64), 3 * pitch)
    axes = quat_to_matrix(np.asarray(quats[large], dtype=np.float64)) * scale[:, None, :]
    order = np.argsort(-scale, axis=1)[:, :2]
    first = np.take_along_axis(axes, order[:, None, :1], axis=2)[..., 0]
    second = np.take_along_axis(axes, order[:, None, 1:], axis=2)[..., 0]
    steps = (-1.0, -0.5, 0.0, 0.5, 1.0)
    offsets = [a * first + b * second for a, b in itertools.product(steps, steps) if a * a + b * b <= 1]
    return np.concatenate([points[large] + offset for offset in offsets])


def _without_specks(shell: Array) -> Array:
    """The shell without clusters of less than a thousandth of its voxels: strays, not parts."""
    from scipy import ndimage

    label, count = ndimage.label(shell, structure=np.ones((3, 3, 3)))
    size = np.bincount(label.ravel(), minlength=count + 1)
    size[0] = 0
    keep = size >= max(2.0, 1e-3 * size.sum())
    if size[keep].sum() < 0.5 * size.sum():  # all in crumbs: a sparse object, not strays
        return shell
    return keep[label]


def _filled(shell: Array) -> Array:
    from scipy import ndimage

    block = np.ones((3, 3, 3), dtype=bool)
    closed = ndimage.binary_closing(shell, structure=block)
    outside, _ = ndimage.label(~closed)
    inside = ~closed & ((outside != outside[0, 0, 0]) | (enclosure(closed) >= _ENCLOSED))
    # Of what the closing added, only the lining of the inside is kept, so that narrow gaps stay open.
    solid = shell | inside | (closed & ndimage.binary_dilation(inside, structure=block))
    # Limbs too thin for the closing to leave an inside are filled by the looks of the shell itself.
    solid |= enclosure(solid) >= _ENCLOSED
    return ndimage.binary_fill_holes(solid)


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
