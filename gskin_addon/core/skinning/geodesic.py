# SPDX-License-Identifier: GPL-3.0-or-later
"""Distances from splats to bones through the inside of the object (after Dionne & de Lasa 2013).

Where the straight way to the closest point of a bone stays inside, the distance is Euclidean and exact. Elsewhere a
shortest path over the 26 neighbours of each voxel leads to where the bone is in sight.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rig.nearest_points import nearest_points
from ..rig.segments import bone_segments
from ..rig.skeleton import Skeleton
from ..splats.cloud import SplatCloud
from ..splats.components import connected_components
from ..ticks import Tick, cores, silent, stretch, work
from .gaps import bridge_pieces
from .voxel_filters import dilate
from .voxels import VoxelGrid, voxelize
from .walls import blocked, nearest_open

Array = NDArray[Any]

_PAIRS = 3_000_000
"""Voxels times bones that a thread has at a time: bounds the memory."""

_THREADS = 2  # more only wait for the memory
_POINTS = 50_000  # at a time
_STEPS = np.array(list(product((-1, 0, 1), repeat=3)))
"""The 27 steps to a voxel and its neighbours; the voxel itself is number 13."""

_UNIT = np.float32(4096)
"""Lengths are whole parts of a voxel, so many to one, rounded down: sums of the same steps are then equal in whatever
order, and bones that are equally far stay so in whatever unit."""

_LENGTHS = (np.floor(np.sqrt(np.square(_STEPS).sum(axis=1)) * _UNIT) / _UNIT).astype(np.float32)


def geodesic_distances(
    means: Array,
    opacities: Array,
    skeleton: Skeleton,
    resolution: int = 96,
    *,
    scales: Array | None = None,
    quats: Array | None = None,
    grid: VoxelGrid | None = None,
    walls: Array | None = None,
    tick: Tick = silent,
) -> Array:
    """Distance (N, B) float32, in metres, from each splat to each bone through the object.

    Parts that do not touch are joined across their gap. A bone outside the object is reached through the air
    from the nearest voxel, a stray splat likewise, so every distance is finite.

    means (N, 3), opacities (N,); `resolution`, `scales`, `quats` as in `voxelize`, or its `grid` ready made. walls
    (N,): labels, 0 for none; no way leads from one label straight to another, only around. A ready made grid must
    have them as well.
    """
    if grid is None:
        grid = voxelize(means, opacities, resolution, scales=scales, quats=quats, walls=walls)
    body = _Inside.of(grid)
    tick(0.1)
    places = _Places.of(body, grid.coordinates(means), walls)
    tick(0.2)
    heads, tails = grid.coordinates(skeleton.heads), grid.coordinates(skeleton.tails)
    out = np.empty((len(means), skeleton.count), dtype=np.float32)
    threads = min(_THREADS, cores())
    size = max(1, min(_PAIRS // (body.count + 1), -(-skeleton.count // (2 * threads))))
    bones = _Bones.of(body, heads, tails)
    tasks = [
        partial(_fill, body, places, bones, range(first, min(first + size, skeleton.count)), out)
        for first in range(0, skeleton.count, size)
    ]
    work(tasks, stretch(tick, 0.2, 1.0), threads)
    out *= np.float32(grid.pitch)
    return out


def body_distances(
    cloud: SplatCloud, skeleton: Skeleton, resolution: int = 96, *, walls: Array | None = None
) -> Array:
    """Distances (N, B) float32, metres, from splats through the body to what each bone really spans.

    As `geodesic_distances`, but to the segments of `bone_segments`: importers invent tails.
    """
    segments = bone_segments(skeleton)
    distances = geodesic_distances(
        cloud.means,
        cloud.opacities,
        segments.skeleton(),
        resolution,
        scales=cloud.scales,
        quats=cloud.quats,
        walls=walls,
    )
    return segments.nearest(distances)


@dataclass(frozen=True)
class _Inside:
    """The M solid voxels of a grid.

    nodes (M, 3): which; centres (3, M) float32; index (X * Y * Z,): the node of each voxel, M in the air; further
    (27, M): the node one of `_STEPS` further, M where there is none and M + 1 where a wall lies between; bridges:
    edges across gaps by the node they start from, as compressed rows: start (M + 1,), target, length in voxels; walls
    (M,): labels or None.
    """

    grid: VoxelGrid
    nodes: Array
    centres: Array
    index: Array
    further: Array
    bridges: tuple[Array, Array, Array]
    walls: Array | None

    @property
    def count(self) -> int:
        """M."""
        return len(self.nodes)

    @classmethod
    def of(cls, grid: VoxelGrid) -> _Inside:
        """The solid voxels of `grid`, which has some."""
        nodes = np.argwhere(grid.solid)
        count, walls = len(nodes), None if grid.walls is None else grid.walls[grid.solid]
        index = np.full(grid.shape, count, np.int32)
        index[grid.solid] = np.arange(count, dtype=np.int32)
        padded = np.pad(index, 1, constant_values=count)
        place = np.ravel_multi_index(tuple((nodes + 1).T), padded.shape)
        stride = np.array([padded.shape[1] * padded.shape[2], padded.shape[2], 1])
        further = np.stack([padded.ravel()[place + int(step @ stride)] for step in _STEPS])
        if walls is not None:
            further[blocked(np.append(walls, 0)[further], walls[None])] = count + 1
        centres = np.ascontiguousarray((nodes + 0.5).T.astype(np.float32))
        return cls(grid, nodes, centres, index.ravel(), further, _bridges(nodes, further, walls), walls)

    def node_at(self, places: Array) -> Array:
        """The node in whose voxel places (K, 3) lie, M outside the object and the grid."""
        voxel = np.floor(places).astype(np.int64)
        inside = ((voxel >= 0) & (voxel < self.grid.shape)).all(axis=1)
        voxel[~inside] = 0
        return np.where(inside, self.index[np.ravel_multi_index(tuple(voxel.T), self.grid.shape)], self.count)


def _bridges(nodes: Array, further: Array, walls: Array | None) -> tuple[Array, Array, Array]:
    """See `_Inside`. A pair of parts is joined wherever its gap is nearly as narrow as at its narrowest, so that a
    plate hovering over a body hangs on it everywhere."""
    count = len(nodes)
    first, second = [], []
    for step in range(13):  # the other half leads back
        linked = np.flatnonzero(further[step] < count)
        first.append(linked)
        second.append(further[step][linked])
    part = connected_components(count, np.concatenate(first), np.concatenate(second))
    start = np.zeros(count + 1, np.int64)
    if not part.any():
        return start, np.zeros(0, np.int64), np.zeros(0, np.float32)
    surface = np.flatnonzero((further >= count).any(axis=0))
    labels = None if walls is None else walls[surface]
    edge = surface[bridge_pieces(nodes[surface], part[surface], labels, beside=1.0)]
    source, target = np.concatenate([edge, edge[:, ::-1]]).T
    order = np.argsort(source, kind="stable")
    source, target = source[order], target[order]
    np.cumsum(np.bincount(source, minlength=count), out=start[1:])
    length = np.linalg.norm((nodes[source] - nodes[target]).astype(np.float64), axis=1)
    return start, target, _rounded(length)


@dataclass(frozen=True)
class _Bones:
    """heads and axes (B, 3) in voxels; for each bone, at even steps from head to tail: allowance (S,), how long the
    last stretch of a way may lead through the air; seeds (S,) the nearest nodes, and reach (S,) the ways to them;
    labels (S,) of those nodes, where there are walls."""

    heads: Array
    axes: Array
    allowance: list[Array]
    seeds: list[Array]
    reach: list[Array]
    labels: list[Array] | None

    @classmethod
    def of(cls, body: _Inside, heads: Array, tails: Array) -> _Bones:
        """Bones from heads to tails (B, 3)."""
        axes = tails - heads
        steps = (np.linalg.norm(axes, axis=1) * 4).astype(np.int64) + 2
        places = np.concatenate(
            [h + np.linspace(0, 1, n)[:, None] * a for h, a, n in zip(heads, axes, steps, strict=True)]
        )
        node = body.node_at(places)
        outer = np.flatnonzero(node == body.count)
        gap = np.zeros(len(places))
        if len(outer):
            centres = body.nodes + 0.5
            node[outer] = nearest_points(centres, places[outer], 1)[1][:, 0]
            gap[outer] = 1.5 * nearest_points(centres, np.floor(places[outer]) + 0.5, 1)[0][:, 0] + 1.0
        reach = np.linalg.norm(body.nodes[node] + 0.5 - places, axis=1)
        cuts = np.cumsum(steps)[:-1]
        labels = None if body.walls is None else np.split(body.walls[node], cuts)
        allowance, seeds, ways = (np.split(a, cuts) for a in (gap.astype(np.float32), node, _rounded(reach)))
        return cls(heads, axes, allowance, seeds, ways, labels)

    def closest(self, bone: int, places: Array, own: Array | None) -> tuple[Array, Array, Array]:
        """Ways (3, K) from places (3, K) to the closest points of a bone, their lengths (K,), and the allowances (K,).

        own (K,): labels of the places. A bone in the air is beyond a wall if the node nearest to it is.
        """
        dtype = places.dtype
        head, axis = self.heads[bone].astype(dtype), self.axes[bone].astype(dtype)
        way = head[:, None] - places
        along = -(axis @ way) / max(float(axis @ axis), 1e-30)
        np.clip(along, 0, 1, out=along)
        way += axis[:, None] * along
        length = np.sqrt(np.einsum("kn,kn->n", way, way))
        table = self.allowance[bone]
        if not table.any():
            return way, length, np.zeros(1, dtype)
        at = np.rint(along * (len(table) - 1)).astype(np.int64)
        allowance = table[at]
        if own is not None and self.labels is not None:
            allowance[blocked(own, self.labels[bone][at])] = 0
        return way, length, allowance


@dataclass(frozen=True)
class _Places:
    """Where N splats are: points (N, 3) in voxels; own (N,): the node in whose voxel each lies, or the nearest that no
    wall keeps from it; inside (N,): the former."""

    points: Array
    own: Array
    inside: Array

    @classmethod
    def of(cls, body: _Inside, points: Array, walls: Array | None) -> _Places:
        """Splats at points (N, 3) in voxels, with labels (N,) or None."""
        own = body.node_at(points)
        inside = own < body.count
        label = None if walls is None or body.walls is None else np.asarray(walls)
        if label is not None and body.walls is not None:
            inside &= ~blocked(label, np.append(body.walls, 0)[own])
        outer = np.flatnonzero(~inside)
        if len(outer):
            mine = None if label is None else label[outer]
            own[outer] = nearest_open(body.nodes + 0.5, points[outer], body.walls, mine)[1]
        return cls(points, own, inside)


def _first_step(body: _Inside, at: Array, offset: Array, way: Array, length: Array) -> Array:
    """The node (K,), as in `_Inside.further`, that one voxel towards the bone lies in: from `offset` (3, K) in the
    voxel of node `at`, or of each node, along `way` (3, K); the bone's own where it is nearer."""
    step = way / np.maximum(length, 1)
    step += offset
    code = np.floor(step, out=step).astype(np.int8)
    number = (code[0].astype(np.int64) * 3 + code[1]) * 3 + code[2] + 13
    return body.further.reshape(-1)[number * body.count + at]


def _in_sight(body: _Inside, bones: _Bones, bone: int) -> tuple[Array, Array]:
    """Lengths (M,) of the straight ways from the nodes to a bone, and whether they stay inside (M,).

    A node sees the bone if the next one on the way there does, a voxel further on.
    """
    count = body.count
    way, length, allowance = bones.closest(bone, body.centres, body.walls)
    after = _first_step(body, np.arange(count), np.full((3, 1), 0.5, np.float32), way, length)
    end = np.where(length <= 1, count, after)
    # Beyond the last solid voxel only the rest of the way to a bone outside may lie, and not for long.
    end[(after == count) & ((allowance <= 0) | (length - 1 > allowance))] = count + 1
    end[after == count + 1] = count + 1
    jump = np.append(end, [count, count + 1])
    while (jump[:-2] < count).any():
        jump = jump[jump]
    return length, jump[:-2] == count


def _fill(body: _Inside, places: _Places, bones: _Bones, block: range, out: Array, tick: Tick) -> None:
    """out[:, block], in voxels."""
    count = body.count
    distance = np.full((len(block), count + 2), np.inf, np.float32)
    sight = np.zeros((len(block), count + 2), bool)
    rim = np.zeros((len(block), count), bool)
    hangs = np.diff(body.bridges[0]) > 0
    grid = np.zeros(body.grid.shape, bool)
    for row, bone in enumerate(block):
        length, seen = _in_sight(body, bones, bone)
        distance[row, :count][seen], sight[row, :count] = _rounded(length[seen]), seen
        grid[body.grid.solid] = ~seen
        rim[row] = seen & (dilate(grid)[body.grid.solid] | hangs)
        tick(0.3 * (row + 1) / len(block))
    _spread(body, bones, block, distance, rim, stretch(tick, 0.3, 0.8))
    sight[:, count] = False
    part = stretch(tick, 0.8, 1.0)
    for first in range(0, len(places.points), _POINTS):
        rows = slice(first, first + _POINTS)
        own = places.own[rows]
        labels = None if body.walls is None else body.walls[own]
        points = np.ascontiguousarray(places.points[rows].T)
        offset = points - body.nodes[own].T
        near = body.further[:, own]
        reach = np.sqrt(sum(np.square(offset[k] - (_STEPS[:, k] + 0.5)[:, None]) for k in range(3)))
        reach[near >= count] = np.inf
        near[near >= count] = count
        outside = ~places.inside[rows]
        reach[:13, outside] = reach[14:, outside] = np.inf
        for row, bone in enumerate(block):
            way, length, allowance = bones.closest(bone, points, labels)
            after = _first_step(body, own, np.where(outside, 0.5, offset), way, length)
            seen = sight[row][after] | ((after < count) & (length <= 1))
            seen |= (after == count) & (allowance > 0) & (length - 1 <= allowance)
            seen &= ~outside
            around = (distance[row][near] + reach).min(axis=0)
            out[rows, bone] = np.where(seen, length, np.maximum(around, length))
            part((first + (row + 1) / len(block) * len(own)) / len(places.points))


def _rounded(length: Array) -> Array:
    """See `_UNIT`; float32."""
    return (np.floor(length * _UNIT) / _UNIT).astype(np.float32)


def _spread(body: _Inside, bones: _Bones, block: range, distance: Array, rim: Array, tick: Tick) -> None:
    """Fill distance (B, M + 2), which is infinite where a bone of the block is not in sight, by shortest paths.

    All (bone, node) pairs at once, in buckets of one voxel: no edge is shorter, so each pair leaves its bucket with its
    final distance (Dial 1969). rim (B, M): the pairs in sight that others may build on.
    """
    count, width = body.count, body.count + 2
    start, target, length = body.bridges
    flat = distance.reshape(-1)
    waiting: dict[int, list[Array]] = {}

    def put(pairs: Array) -> None:
        """Into the buckets of their distances."""
        bucket = flat[pairs].astype(np.int32)
        if not len(bucket):
            return
        low, high = int(bucket.min()), int(bucket.max())
        if high - low > 4:
            order = np.argsort(bucket, kind="stable")
            cuts = np.searchsorted(bucket[order], np.arange(low, high + 2))
            for number, (a, b) in enumerate(pairwise(cuts.tolist())):
                if b > a:
                    waiting.setdefault(low + number, []).append(pairs[order[a:b]])
        else:
            for number in range(low, high + 1):
                waiting.setdefault(number, []).append(pairs[bucket == number])

    seeds = []
    for row, bone in enumerate(block):
        at = bones.seeds[bone] + row * width
        fresh = bones.reach[bone] < flat[at]
        np.minimum.at(flat, at[fresh], bones.reach[bone][fresh])
        seeds.append(at[fresh])
    rows, nodes = np.nonzero(rim)
    put(np.concatenate([rows * width + nodes, np.unique(np.concatenate(seeds))]))
    distance[:, count:] = -np.inf  # never reached
    settled = np.zeros(flat.shape, bool)
    stamp = np.empty(flat.shape, np.int32)
    done = 0
    while waiting:
        now = min(waiting)
        pairs = np.concatenate(waiting.pop(now))
        pairs = pairs[~settled[pairs]]
        pairs = pairs[flat[pairs] < now + 1]
        stamp[pairs] = np.arange(len(pairs), dtype=np.int32)
        pairs = pairs[stamp[pairs] == np.arange(len(pairs))]  # each once
        settled[pairs] = True
        done += len(pairs)
        for first in range(0, len(pairs), 8192):
            some = pairs[first : first + 8192]
            base = some // width * width
            node = some - base
            way = flat[some] + _LENGTHS[:, None]
            to = body.further[:, node] + base
            better = way < flat[to]
            to, way = to[better], way[better]
            np.minimum.at(flat, to, way)
            put(to)
            hanging = np.flatnonzero(start[node + 1] > start[node])
            if len(hanging):
                edges = start[node[hanging] + 1] - start[node[hanging]]
                edge = np.repeat(start[node[hanging]] - np.cumsum(edges) + edges, edges) + np.arange(edges.sum())
                source = np.repeat(hanging, edges)
                to, way = target[edge] + base[source], flat[some[source]] + length[edge]
                better = way < flat[to]
                np.minimum.at(flat, to[better], way[better])
                put(to[better])
        tick(min(1.0, done / (0.8 * len(block) * count)))
    distance[:, count:] = np.inf
