# SPDX-License-Identifier: GPL-3.0-or-later
"""From splats and a skeleton to the network's input: distances, heat, parts, description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...guidance.elastic import ElasticBody
from ...rig.segments import bone_segments
from ...rig.skeleton import Skeleton
from ...splats.cloud import SplatCloud
from ..extent import unit_frame
from ..geodesic import geodesic_distances
from ..voxels import voxelize
from .features import Description, describe
from .parts import Parts, even_subset, find_parts

Array = NDArray[Any]

RESOLUTION = 64
HEAT_NODES = 2000
DIFFUSE = 0.15
"""Handle strength of the weak equilibrium, as a part of the strong one's."""


@dataclass(frozen=True)
class Body:
    """Some splats of an object, described.

    index (N,): which splats; points, colors (N, 3); distances, heat (N, B); parts of these N splats; rows (M,):
    the described ones among them; description; size: the object's diagonal.
    """

    index: Array
    points: Array
    colors: Array
    distances: Array
    heat: Array
    parts: Parts
    rows: Array
    description: Description
    size: float


def look_at(
    cloud: SplatCloud,
    skeleton: Skeleton,
    *,
    limit: int = 5000,
    rows: int | None = None,
    resolution: int = RESOLUTION,
) -> Body:
    """Describe about `limit` splats, evenly spread over the object; only `rows` of them in the end."""
    _, size = unit_frame(cloud.means)
    grid = voxelize(cloud.means, cloud.opacities, resolution, scales=cloud.scales, quats=cloud.quats)
    index = even_subset(cloud.means, limit)
    part = cloud.select(index)
    segments = bone_segments(skeleton)
    distances = segments.nearest(
        geodesic_distances(part.means, part.opacities, segments.skeleton(), resolution, grid=grid)
    )
    body = ElasticBody(part, distances, nodes=HEAT_NODES)
    heat, diffuse = body.weights(), body.weights(strength=DIFFUSE)
    points, colors = part.means.astype(np.float64), part.base_colors()
    parts = find_parts(points, colors, distances)
    chosen = np.arange(len(points)) if rows is None else even_subset(points, rows)
    described = describe(
        points, surface_normals(points), skeleton, distances, heat, diffuse, parts, size, rows=chosen
    )
    return Body(index, points, colors, distances, heat, parts, chosen, described, size)


def surface_normals(points: Array, neighbours: int = 12) -> Array:
    """(N, 3) unit normals, of either sign: the direction in which the nearest splats spread least."""
    from scipy.spatial import cKDTree

    k = min(neighbours, len(points))
    near = points[cKDTree(points).query(points, k)[1].reshape(len(points), -1)]
    near = near - near.mean(axis=1, keepdims=True)
    spread = np.einsum("nki,nkj->nij", near, near)
    return np.linalg.eigh(spread)[1][:, :, 0]
