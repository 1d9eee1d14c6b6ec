# SPDX-License-Identifier: GPL-3.0-or-later
"""Distances from splats to bones through the inside of the object (after Dionne & de Lasa 2013).

Where the straight way to the closest point of a bone stays inside, the distance is Euclidean and exact.
Elsewhere a shortest path over the 26 neighbours of each voxel leads to where the bone is in sight; paths are
straightened on the way (lazy Theta*, Nash et al. 2010), since paths along voxel edges come out up to 9 % too
long.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..rig.segments import bone_segments
from ..rig.skeleton import Skeleton
from ..splats.cloud import SplatCloud
from .visibility import closest_on_segment
from .voxels import VoxelGrid, voxelize

Array = NDArray[Any]

_BLOCK = 16  # bones at a time: bounds the memory of the voxel distances


def geodesic_distances(
    means: Array,
    opacities: Array,
    skeleton: Skeleton,
    resolution: int = 96,
    *,
    scales: Array | None = None,
    quats: Array | None = None,
    grid: VoxelGrid | None = None,
) -> Array:
    """Distance (N, B) float32, in metres, from each splat to each bone through the object.

    Parts that do not touch are joined across their gap. A bone outside the object is reached through the air
    from the nearest voxel, a stray splat likewise, so every distance is finite.

    means (N, 3), opacities (N,); `resolution`, `scales`, `quats` as in `voxelize`, or its `grid` ready made.
    """
    if grid is None:
        grid = voxelize(means, opacities, resolution, scales=scales, quats=quats)
    nodes = np.argwhere(grid.solid).astype(np.int32)
    ids = np.full(grid.shape, -1, dtype=np.int32)
    ids[tuple(nodes.T)] = np.arange(len(nodes), dtype=np.int32)
    air, nearest = _nearest_solid(grid.solid, ids)
    start, target, length = _bridges(grid.solid, ids, nodes, nearest)
    points = np.ascontiguousarray(grid.coordinates(means))
    heads, tails = grid.coordinates(skeleton.heads), grid.coordinates(skeleton.tails)
    out = np.empty((len(points), skeleton.count), dtype=np.float32)
    for first in range(0, skeleton.count, _BLOCK):
        block = slice(first, min(first + _BLOCK, skeleton.count))
        distance = np.empty((block.stop - first, len(nodes)), dtype=np.float32)
        _bone_distances(
            nodes, ids, air, nearest, heads[block], tails[block], start, target, length, distance
        )
        part = np.empty((len(points), block.stop - first), dtype=np.float32)
        _point_distances(points, nodes, ids, air, nearest, heads[block], tails[block], distance, part)
        out[:, block] = part
    out *= np.float32(grid.pitch)
    return out


def body_distances(cloud: SplatCloud, skeleton: Skeleton, resolution: int = 96) -> Array:
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
    )
    return segments.nearest(distances)


def _nearest_solid(solid: Array, ids: Array) -> tuple[Array, Array]:
    """For every voxel: distance in voxels to the nearest solid one (float32) and that one's node (int32)."""
    from scipy import ndimage

    distance, index = ndimage.distance_transform_edt(~solid, return_indices=True)
    return distance.astype(np.float32), np.ascontiguousarray(ids[tuple(index)])


def _bridges(solid: Array, ids: Array, nodes: Array, nearest: Array) -> tuple[Array, Array, Array]:
    """Edges across the gaps between parts, as compressed rows: start (M + 1,), target, length in voxels.

    Parts are joined along the minimum spanning tree of their gaps; a pair of parts is joined wherever its gap
    is nearly as narrow as at its narrowest, so that a plate hovering over a body hangs on it everywhere.
    """
    from scipy import ndimage, sparse

    label, count = ndimage.label(solid, structure=np.ones((3, 3, 3)))
    start = np.zeros(len(nodes) + 1, dtype=np.int64)
    if count < 2:
        return start, np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.float32)
    part = label[tuple(nodes.T)]
    # Where the regions of nearest solid voxels meet, the two nearest voxels face each other across a gap.
    pairs = []
    for axis in range(3):
        a = np.moveaxis(nearest, axis, 0)[:-1].ravel()
        b = np.moveaxis(nearest, axis, 0)[1:].ravel()
        apart = part[a] != part[b]
        pairs.append(np.column_stack([a[apart], b[apart]]))
    edge = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)
    gap = np.linalg.norm((nodes[edge[:, 0]] - nodes[edge[:, 1]]).astype(np.float64), axis=1)
    low = np.minimum(part[edge[:, 0]], part[edge[:, 1]]).astype(np.int64)
    high = np.maximum(part[edge[:, 0]], part[edge[:, 1]]).astype(np.int64)
    key = low * (count + 1) + high
    unique, inverse = np.unique(key, return_inverse=True)
    narrowest = np.full(len(unique), np.inf)
    np.minimum.at(narrowest, inverse, gap)
    graph = sparse.coo_matrix((narrowest, (unique // (count + 1), unique % (count + 1))))
    graph.resize((count + 1, count + 1))
    tree = sparse.csgraph.minimum_spanning_tree(graph.tocsr()).tocoo()
    chosen = np.isin(key, np.minimum(tree.row, tree.col) * (count + 1) + np.maximum(tree.row, tree.col))
    chosen &= gap <= 1.5 * narrowest[inverse] + 1
    a, b, gap = edge[chosen, 0], edge[chosen, 1], gap[chosen]
    source, target = np.concatenate([a, b]), np.concatenate([b, a])
    order = np.argsort(source, kind="stable")
    np.add.at(start, source + 1, 1)
    lengths = np.concatenate([gap, gap])[order].astype(np.float32)
    return np.cumsum(start), target[order].astype(np.int32), lengths


@njit(cache=True)
def _in_sight(ids, p, q, allowance):  # type: ignore[no-untyped-def]
    """Whether the segment p -> q (voxel units) stays in solid voxels, but for a last stretch of at most
    `allowance`.

    Sampled at every half voxel.
    """
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    steps = int(length * 2) + 1
    nx, ny, nz = ids.shape
    for s in range(1, steps + 1):
        t = s / steps
        i, j, k = math.floor(p[0] + t * dx), math.floor(p[1] + t * dy), math.floor(p[2] + t * dz)
        inside = 0 <= i < nx and 0 <= j < ny and 0 <= k < nz and ids[i, j, k] >= 0
        if inside:
            continue
        # In the air: only the rest of the way may be, and not for long.
        if (1 - t) * length > allowance or allowance <= 0:
            return False
    return True


@njit(cache=True)
def _air_at(air, q):  # type: ignore[no-untyped-def]
    """Distance in voxels from a point to the nearest solid voxel, 0 inside; works beyond the grid."""
    i = min(max(math.floor(q[0]), 0), air.shape[0] - 1)
    j = min(max(math.floor(q[1]), 0), air.shape[1] - 1)
    k = min(max(math.floor(q[2]), 0), air.shape[2] - 1)
    dx, dy, dz = q[0] - (i + 0.5), q[1] - (j + 0.5), q[2] - (k + 0.5)
    out = max(abs(dx), abs(dy), abs(dz)) - 0.5
    if out <= 0:
        return float(air[i, j, k])
    return float(air[i, j, k]) + math.sqrt(dx * dx + dy * dy + dz * dz)


@njit(cache=True)
def _closest(p, head, tail, q):  # type: ignore[no-untyped-def]
    """Write the point of the bone closest to p into q; returns the distance."""
    ab = tail - head
    t = closest_on_segment(p, head, ab, max(ab[0] ** 2 + ab[1] ** 2 + ab[2] ** 2, 1e-300))
    total = 0.0
    for k in range(3):
        q[k] = head[k] + t * ab[k]
        total += (p[k] - q[k]) ** 2
    return math.sqrt(total)


@njit(cache=True)
def _allowance(air, q):  # type: ignore[no-untyped-def]
    gap = _air_at(air, q)
    return 0.0 if gap <= 0 else 1.5 * gap + 1.0


@njit(cache=True)
def _sift_up(heap, place, key, at):  # type: ignore[no-untyped-def]
    node = heap[at]
    while at > 0:
        up = (at - 1) >> 1
        if key[heap[up]] <= key[node]:
            break
        heap[at] = heap[up]
        place[heap[at]] = at
        at = up
    heap[at] = node
    place[node] = at


@njit(cache=True)
def _pop(heap, place, key, size):  # type: ignore[no-untyped-def]
    """Take the node with the smallest key off a heap of `size` nodes."""
    top = heap[0]
    node = heap[size - 1]
    size -= 1
    at = 0
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and key[heap[child + 1]] < key[heap[child]]:
            child += 1
        if key[heap[child]] >= key[node]:
            break
        heap[at] = heap[child]
        place[heap[at]] = at
        at = child
    heap[at] = node
    place[node] = at
    place[top] = -2
    return top


@njit(parallel=True, cache=True)
def _bone_distances(nodes, ids, air, nearest, heads, tails, start, target, length, out):  # type: ignore[no-untyped-def]
    """out (B, M): distance in voxels from the centre of every solid voxel to every bone."""
    for b in prange(len(heads)):
        _one_bone(nodes, ids, air, nearest, heads[b], tails[b], start, target, length, out[b])


@njit(cache=True)
def _one_bone(nodes, ids, air, nearest, head, tail, start, target, length, d):  # type: ignore[no-untyped-def]
    count = len(nodes)
    nx, ny, nz = ids.shape
    anchor = np.full(count, -1, dtype=np.int32)  # the voxel in sight whose distance the path builds on
    before = np.full(count, -1, dtype=np.int32)  # the voxel before it on the path
    place = np.full(count, -1, dtype=np.int32)  # position in the heap, -1 never there, -2 done
    heap = np.empty(count, dtype=np.int32)
    size = 0
    p, q = np.empty(3), np.empty(3)
    for n in range(count):
        for k in range(3):
            p[k] = nodes[n, k] + 0.5
        euclid = _closest(p, head, tail, q)
        if _in_sight(ids, p, q, _allowance(air, q)):
            d[n] = euclid
            place[n] = -2  # no way is shorter
        else:
            d[n] = np.inf
    # Bones, or parts of them, outside the object: through the air to the nearest voxel.
    bone = math.sqrt((tail[0] - head[0]) ** 2 + (tail[1] - head[1]) ** 2 + (tail[2] - head[2]) ** 2)
    samples = int(bone * 2) + 2
    for s in range(samples + 1):
        for k in range(3):
            q[k] = head[k] + s / samples * (tail[k] - head[k])
        i = min(max(math.floor(q[0]), 0), nx - 1)
        j = min(max(math.floor(q[1]), 0), ny - 1)
        k = min(max(math.floor(q[2]), 0), nz - 1)
        n = nearest[i, j, k]
        if place[n] == -2:
            continue
        way = 0.0
        for axis in range(3):
            way += (nodes[n, axis] + 0.5 - q[axis]) ** 2
        way = math.sqrt(way)
        if way < d[n]:
            d[n] = way
            anchor[n] = before[n] = n
            if place[n] == -1:
                heap[size] = n
                place[n] = size
                size += 1
            _sift_up(heap, place, d, place[n])
    # The rim of what is in sight.
    for n in range(count):
        if place[n] == -2:
            size = _relax(nodes, ids, start, target, length, d, anchor, before, place, heap, size, n, n)
    while size > 0:
        n = _pop(heap, place, d, size)
        size -= 1
        a = anchor[n]
        if a >= 0 and a != n:
            # Straighten the path: from the anchor in a line, if nothing is in between.
            for k in range(3):
                p[k] = nodes[a, k] + 0.5
                q[k] = nodes[n, k] + 0.5
            straight = d[a] + math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
            if straight < d[n]:
                if _in_sight(ids, p, q, 0.0):
                    d[n] = straight
                else:
                    anchor[n] = before[n]
        size = _relax(nodes, ids, start, target, length, d, anchor, before, place, heap, size, n, anchor[n])


@njit(cache=True)
def _relax(nodes, ids, start, target, length, d, anchor, before, place, heap, size, n, a):  # type: ignore[no-untyped-def]
    """Offer the neighbours of node n the way through it; returns the size of the heap."""
    nx, ny, nz = ids.shape
    x, y, z = nodes[n, 0], nodes[n, 1], nodes[n, 2]
    for i in range(max(x - 1, 0), min(x + 2, nx)):
        for j in range(max(y - 1, 0), min(y + 2, ny)):
            for k in range(max(z - 1, 0), min(z + 2, nz)):
                m = ids[i, j, k]
                if m < 0 or place[m] == -2:
                    continue
                step = d[n] + math.sqrt(float((i - x) * (i - x) + (j - y) * (j - y) + (k - z) * (k - z)))
                size = _offer(d, anchor, before, place, heap, size, m, step, a, n)
    for e in range(start[n], start[n + 1]):
        m = target[e]
        if place[m] != -2:
            size = _offer(d, anchor, before, place, heap, size, m, d[n] + length[e], m, m)
    return size


@njit(cache=True)
def _offer(d, anchor, before, place, heap, size, m, way, a, n):  # type: ignore[no-untyped-def]
    if way >= d[m]:
        return size
    d[m] = way
    anchor[m] = a
    before[m] = n
    if place[m] == -1:
        heap[size] = m
        place[m] = size
        size += 1
    _sift_up(heap, place, d, place[m])
    return size


@njit(parallel=True, cache=True)
def _point_distances(points, nodes, ids, air, nearest, heads, tails, distance, out):  # type: ignore[no-untyped-def]
    """out (N, B): distance in voxels from every point to every bone, by sight or over the voxels around."""
    nx, ny, nz = ids.shape
    for s in prange(len(points)):
        p, q = points[s], np.empty(3)
        x = min(max(math.floor(p[0]), 0), nx - 1)
        y = min(max(math.floor(p[1]), 0), ny - 1)
        z = min(max(math.floor(p[2]), 0), nz - 1)
        inside = ids[x, y, z] >= 0
        near, way = np.empty(27, dtype=np.int32), np.empty(27)
        count = 0
        if inside:
            for i in range(max(x - 1, 0), min(x + 2, nx)):
                for j in range(max(y - 1, 0), min(y + 2, ny)):
                    for k in range(max(z - 1, 0), min(z + 2, nz)):
                        if ids[i, j, k] >= 0:
                            near[count] = ids[i, j, k]
                            way[count] = math.sqrt(
                                (p[0] - i - 0.5) ** 2 + (p[1] - j - 0.5) ** 2 + (p[2] - k - 0.5) ** 2
                            )
                            count += 1
        else:
            near[0] = n = nearest[x, y, z]
            way[0] = math.sqrt(
                (p[0] - nodes[n, 0] - 0.5) ** 2
                + (p[1] - nodes[n, 1] - 0.5) ** 2
                + (p[2] - nodes[n, 2] - 0.5) ** 2
            )
            count = 1
        for b in range(len(heads)):
            euclid = _closest(p, heads[b], tails[b], q)
            if inside and _in_sight(ids, p, q, _allowance(air, q)):
                out[s, b] = euclid
                continue
            best = np.inf
            for c in range(count):
                best = min(best, distance[b, near[c]] + way[c])
            out[s, b] = max(best, euclid)
