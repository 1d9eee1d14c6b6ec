# SPDX-License-Identifier: GPL-3.0-or-later
"""From splats and a skeleton to the network's input: distances, heat, parts, description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.nearest_points import nearest_points
from ...rig.segments import bone_segments
from ...rig.skeleton import Skeleton
from ...splats.cloud import SplatCloud
from ...ticks import Tick, silent, stretch
from ..extent import unit_frame
from ..geodesic import geodesic_distances
from ..heat import CLOSEST, NORMAL_WEIGHTED_STRENGTH, BoneHeat
from ..node_graph import build_graph
from ..normal_weighted_distance import (
    NEIGHBOURS,
    consistent_normals,
    normal_weighted_distances,
    outward_normals,
    surface_normals,
)
from ..voxels import voxelize
from .features import Description, Reach, describe
from .parts import Parts, even_subset, find_parts

Array = NDArray[Any]

RESOLUTION, NORMAL_RESOLUTION = 110, 144
"""Voxels along the longest side for distances and for which way is out, where the splats are dense enough. With 72
for distances the errors on 34 bodies of 20,000 splats are 1 to 3 % higher."""

HEAT_NODES = 2000
DIFFUSE, HARD = 0.15, 5.0
"""Handle strengths of the weak and the strong equilibrium, as parts of the usual one's."""


@dataclass(frozen=True)
class Body:
    """Some splats of an object, described.

    index (N,): which splats; points, colors, normals, out (N, 3), see `outward_normals` and
    `consistent_normals`; reach and parts of these N splats; walls (N,): their labels, or None;
    rows (M,): the described ones among them; description; size: the object's diagonal.
    """

    index: Array
    points: Array
    colors: Array
    normals: Array
    out: Array
    reach: Reach
    parts: Parts
    rows: Array
    description: Description
    size: float
    walls: Array | None = None


def describe_body(
    cloud: SplatCloud,
    skeleton: Skeleton,
    *,
    limit: int = 5000,
    rows: int | None = None,
    resolution: int = RESOLUTION,
    walls: Array | None = None,
    tick: Tick = silent,
) -> Body:
    """Describe about `limit` splats, evenly spread over the object; only `rows` of them in the end.

    walls (N,): labels of all splats, 0 for none; what has different ones does not touch, see `walls`.
    """
    walls = None if walls is None else np.asarray(walls)
    _, size = unit_frame(cloud.means)
    tick(0.0)
    grid = voxelize(
        cloud.means, cloud.opacities, resolution, scales=cloud.scales, quats=cloud.quats, walls=walls,
        tick=stretch(tick, 0.0, 0.08),
    )  # fmt: skip
    index = even_subset(cloud.means, limit, stretch(tick, 0.08, 0.1))
    part, own = cloud.select(index), None if walls is None else walls[index]
    segments = bone_segments(skeleton)
    ways = geodesic_distances(
        part.means, part.opacities, segments.skeleton(), grid=grid, walls=own, tick=stretch(tick, 0.1, 0.4)
    )
    distances = segments.nearest(ways)
    points, colors = part.means.astype(np.float64), part.base_colors()
    around = nearest_points(points, points, min(NEIGHBOURS, len(points)))
    normals = surface_normals(points, near=around[1])
    tick(0.43)
    fine = voxelize(
        cloud.means, cloud.opacities, NORMAL_RESOLUTION, scales=cloud.scales, quats=cloud.quats,
        tick=stretch(tick, 0.43, 0.5),
    )  # fmt: skip
    out = consistent_normals(points, outward_normals(points, normals, fine), distances.min(axis=1), size, around)
    tick(0.53)
    faced = normal_weighted_distances(points, out, segments, ways, CLOSEST * size)
    tick(0.55)
    graph = build_graph(part.means, distances, HEAT_NODES, walls=own)
    tick(0.6)
    body = BoneHeat(
        part,
        distances,
        handle_distances=faced,
        strength=NORMAL_WEIGHTED_STRENGTH,
        graph=graph,
        tick=stretch(tick, 0.6, 0.65),
    )
    plain = BoneHeat(part, distances, graph=graph, tick=stretch(tick, 0.65, 0.7)).weights()
    diffuse = body.weights(strength=DIFFUSE, tick=stretch(tick, 0.7, 0.78))
    hard = body.weights(strength=HARD, tick=stretch(tick, 0.78, 0.82))
    reach = Reach(distances, faced, body.weights(), diffuse, hard, plain)
    parts = find_parts(points, colors, distances, around=around, walls=own)
    tick(0.92)
    chosen = np.arange(len(points)) if rows is None else even_subset(points, rows)
    described = describe(points, normals, out, skeleton, reach, parts, size, rows=chosen)
    return Body(index, points, colors, normals, out, reach, parts, chosen, described, size, own)
