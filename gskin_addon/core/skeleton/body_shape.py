# SPDX-License-Identifier: GPL-3.0-or-later
"""What the surface of a body looks like around each of its voxels: thickness, ways through the body, nearest end.

The same for dense and sparse splats, because voxels are described, not splats.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..skinning.gaps import bridge_pieces
from ..skinning.voxels import VoxelGrid, voxelize
from ..splats.cloud import SplatCloud
from ..splats.components import connected_components

Array = NDArray[Any]

RESOLUTION = 48
"""Voxels along the longest side."""

REACHES = (1, 2, 4, 7, 12)
"""Half edges, in voxels, of the boxes in which the body around a voxel is looked at."""

ENDS = 8
"""How many ends of limbs are looked for."""

_STEPS = np.array([s for s in product((-1, 0, 1), repeat=3) if s > (0, 0, 0)])
"""One of each pair of opposite steps to a neighbouring voxel."""


@dataclass(frozen=True)
class BodyShape:
    """The M surface voxels of a body, lengths in metres.

    points (M, 3); filled (M, R): share of the boxes of `REACHES` around each that is solid; lean (M, R, 3): from the
    voxel to the middle of what is solid in these boxes; below, above, inside (M,): ways through the body from its
    lowest voxels, its highest and its middle; end (M, 3): the end of a limb that is nearest through the body; beyond
    (M,): the way to it. low, high (3,): the box of the body.
    """

    points: Array
    filled: Array
    lean: Array
    below: Array
    above: Array
    inside: Array
    end: Array
    beyond: Array
    low: Array
    high: Array

    def turned(self, rotation: Array, about: Array) -> BodyShape:
        """The same body after a turn by rotation (3, 3) about a point (3,); by quarters only, as `filled` stays."""
        corners = (np.stack([self.low, self.high]) - about) @ rotation.T + about
        return replace(
            self,
            points=(self.points - about) @ rotation.T + about,
            lean=self.lean @ rotation.T,
            end=(self.end - about) @ rotation.T + about,
            low=corners.min(axis=0),
            high=corners.max(axis=0),
        )


def body_shape(cloud: SplatCloud, resolution: int = RESOLUTION) -> BodyShape:
    """The shape of what splats cover, z up.

    Raises:
        InputError: fewer than two splats.
    """
    grid = voxelize(cloud.means, cloud.opacities, resolution, scales=cloud.scales, quats=cloud.quats)
    return shape_of(grid)


def shape_of(grid: VoxelGrid) -> BodyShape:
    """The shape of a voxel model with at least one solid voxel, z up."""
    nodes = np.argwhere(grid.solid)
    ways = _Ways(grid.solid, nodes)
    height = nodes[:, 2]
    span = max(int(np.ptp(height)), 1)
    lowest = np.flatnonzero(height <= height.min() + max(1, round(0.03 * span)))
    highest = np.flatnonzero(height >= height.max() - max(1, round(0.02 * span)))
    below, above = ways.lengths([lowest, highest]).T
    middle = ways.middle()
    inside = ways.lengths([np.array([middle])])[:, 0]
    ends = ways.ends(middle, inside, ENDS)
    reach = ways.lengths([np.array([end]) for end in ends])
    nearest = reach.argmin(axis=1)
    surface = np.flatnonzero(ways.degree < 26)
    filled, lean = _surroundings(grid.solid, nodes[surface])
    points = grid.centers(nodes)
    return BodyShape(
        points[surface],
        filled,
        lean * grid.pitch,
        below[surface] * grid.pitch,
        above[surface] * grid.pitch,
        inside[surface] * grid.pitch,
        points[np.array(ends)[nearest]][surface],
        reach.min(axis=1)[surface] * grid.pitch,
        points.min(axis=0) - grid.pitch / 2,
        points.max(axis=0) + grid.pitch / 2,
    )


class _Ways:
    """Shortest ways between the solid voxels over their 26 neighbours and across the gaps between parts."""

    def __init__(self, solid: Array, nodes: Array) -> None:
        self.count = len(nodes)
        index = np.full(np.array(solid.shape) + 2, -1, np.int64)
        index[tuple((nodes + 1).T)] = np.arange(self.count)
        first, second, length = [], [], []
        for step in _STEPS:
            other = index[tuple((nodes + 1 + step).T)]
            linked = np.flatnonzero(other >= 0)
            first.append(linked)
            second.append(other[linked])
            length.append(np.full(len(linked), np.linalg.norm(step)))
        a, b, way = np.concatenate(first), np.concatenate(second), np.concatenate(length)
        self.degree = np.bincount(a, minlength=self.count) + np.bincount(b, minlength=self.count)
        part = connected_components(self.count, a, b)
        if part.any():
            outer = np.flatnonzero(self.degree < 26)
            bridge = outer[bridge_pieces(nodes[outer], part[outer], None, beside=1.0)]
            a, b = np.concatenate([a, bridge[:, 0]]), np.concatenate([b, bridge[:, 1]])
            far = np.linalg.norm((nodes[bridge[:, 0]] - nodes[bridge[:, 1]]).astype(np.float64), axis=1)
            way = np.concatenate([way, far])
        source, target = np.concatenate([a, b]), np.concatenate([b, a])
        order = np.argsort(source, kind="stable")
        self.target, self.way = target[order], np.concatenate([way, way])[order].astype(np.float32)
        self.start = np.concatenate([[0], np.cumsum(np.bincount(source, minlength=self.count))])

    def lengths(self, seeds: list[Array]) -> Array:
        """(M, S) float32, in voxels: the way from each node to the nearest of each list of seeds.

        In buckets of one voxel: no way is shorter, so each node leaves its bucket with its final length (Dial 1969).
        """
        count, sets = self.count, len(seeds)
        found = np.full(count * sets, np.inf, np.float32)
        fresh = np.concatenate([np.asarray(nodes) * sets + number for number, nodes in enumerate(seeds)])
        found[fresh] = 0
        waiting, bucket = fresh, 0
        while len(waiting):
            now = waiting[found[waiting] < bucket + 1]
            later = waiting[found[waiting] >= bucket + 1]
            bucket += 1
            if not len(now):
                waiting = later
                bucket = int(found[waiting].min())
                continue
            node, number = np.divmod(now, sets)
            begin, many = self.start[node], self.start[node + 1] - self.start[node]
            edge = np.repeat(begin - np.concatenate([[0], np.cumsum(many)[:-1]]), many) + np.arange(many.sum())
            place = self.target[edge] * sets + np.repeat(number, many)
            length = np.repeat(found[now], many) + self.way[edge]
            shorter = length < found[place]
            place, length = place[shorter], length[shorter]
            np.minimum.at(found, place, length)
            waiting = np.unique(np.concatenate([later, place]))
        return found.reshape(count, sets)

    def middle(self) -> int:
        """The node from which the farthest of some nodes all over the body is nearest."""
        far = [int(self.lengths([np.array([0])])[:, 0].argmax())]
        reach = self.lengths([np.array(far)])
        for _ in range(5):
            far.append(int(reach.min(axis=1).argmax()))
            reach = np.concatenate([reach, self.lengths([np.array(far[-1:])])], axis=1)
        return int(np.square(reach).sum(axis=1).argmin())

    def ends(self, middle: int, inside: Array, count: int) -> list[int]:
        """Nodes far from the middle and from one another."""
        ends = [int(inside.argmax())]
        nearest = np.minimum(inside, self.lengths([np.array(ends)])[:, 0])
        while len(ends) < count:
            ends.append(int(nearest.argmax()))
            nearest = np.minimum(nearest, self.lengths([np.array(ends[-1:])])[:, 0])
        return ends


def _surroundings(solid: Array, nodes: Array) -> tuple[Array, Array]:
    """filled (M, R) and lean (M, R, 3), in voxels, of `BodyShape`, by sums over boxes."""
    reach = max(REACHES)
    padded = np.pad(solid, reach).astype(np.float64)
    axes = np.meshgrid(*[np.arange(n, dtype=np.float64) for n in padded.shape], indexing="ij", sparse=True)
    fields = [padded, *(padded * axis for axis in axes)]
    sums = [np.pad(field.cumsum(0).cumsum(1).cumsum(2), ((1, 0),) * 3) for field in fields]
    at = nodes + reach
    filled, lean = np.empty((len(nodes), len(REACHES))), np.empty((len(nodes), len(REACHES), 3))
    for number, half in enumerate(REACHES):
        low, high = at - half, at + half + 1
        mass, *moments = (_box(total, low, high) for total in sums)
        filled[:, number] = mass / (2 * half + 1) ** 3
        lean[:, number] = np.stack(moments, axis=1) / np.maximum(mass, 1)[:, None] - at
    return filled, lean


def _box(total: Array, low: Array, high: Array) -> Array:
    """Sums over boxes from low to before high (M, 3), of a table of sums from the origin."""
    out = np.zeros(len(low))
    for corner in product((0, 1), repeat=3):
        pick = np.where(np.array(corner, bool), high, low)
        sign = 1 if sum(corner) % 2 else -1
        out += sign * total[tuple(pick.T)]
    return out
