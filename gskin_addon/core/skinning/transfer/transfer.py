# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights from a mesh or from splats to splats or a mesh: matched where that is safe, inpainted elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...rig.vertex_maps import mesh_neighbours
from ...splats.cloud import SplatCloud
from ...splats.components import connected_components
from ...ticks import Tick, silent, stretch
from ..edits.blend import follow_neighbours
from ..edits.body_graph import BodyGraph, body_graph
from .align import align
from .facing import splat_facing, vertex_facing
from .match import ANGLE, REACH, Match, among_points, on_surface

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Shape:
    """What weights go to or come from: points (N, 3) in the rest pose, world; facing (N, 3), see `facing`; faces (F, 3)
    of a mesh, None for splats; walls (N,): labels of splats, see `walls`, over which nothing is inpainted."""

    points: Array
    facing: Array
    faces: Array | None = None
    walls: Array | None = None

    @classmethod
    def of_splats(cls, cloud: SplatCloud, walls: Array | None = None, tick: Tick = silent) -> Shape:
        """The splats of a cloud."""
        return cls(np.asarray(cloud.means, np.float64), splat_facing(cloud, tick), None, walls)

    @classmethod
    def of_mesh(cls, verts: Array, faces: Array) -> Shape:
        """verts (V, 3), faces (F, 3). Vertices at one place, as files have them along seams of textures, are one."""
        verts, faces = np.asarray(verts, np.float64), np.asarray(faces)
        welded = _first_there(verts)
        return cls(verts, vertex_facing(verts, welded[faces])[welded], faces)

    @cached_property
    def graph(self) -> BodyGraph:
        """Which points are neighbours: along the edges of a mesh, or of splats those around each, but for gaps, walls
        and what faces it, where two parts of a body touch."""
        if self.faces is None:
            return _without_contacts(body_graph(self.points, walls=self.walls), self.facing)
        own, welded = np.arange(len(self.points)), _first_there(self.points)
        neighbour = mesh_neighbours(len(own), welded[self.faces])[welded]
        length = np.linalg.norm(self.points[neighbour] - self.points[:, None], axis=2)
        length[(neighbour == own[:, None]) | (neighbour == welded[:, None])] = np.inf
        twin = np.where(welded != own, 0.0, np.inf)
        return BodyGraph(
            np.concatenate([neighbour, welded[:, None]], axis=1),
            np.concatenate([length, twin[:, None]], axis=1).astype(np.float32),
        )

    @property
    def pieces(self) -> Array:
        """(F,) the number, from 0 on, of the piece of the mesh that each triangle belongs to."""
        faces = _first_there(self.points)[np.asarray(self.faces)]
        joined = np.concatenate([faces[:, :2], faces[:, 1:]])
        label = connected_components(len(self.points), *joined.T)
        return np.unique(label[faces[:, 0]], return_inverse=True)[1].reshape(-1)

    def fitted(self, onto: Shape, reach: float, tick: Tick = silent) -> Shape:
        """The shape brought onto another one, see `align`; reach: a share of its diagonal."""
        points, facing = self.points, self.facing
        if self.faces is not None:
            points, facing = _spread(self)
        way = reach * float(np.linalg.norm(np.ptp(self.points, axis=0)))
        matrix = align(points, facing, onto.points, onto.facing, way, tick)
        rotation = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3]))
        moved = self.points @ matrix[:3, :3].T + matrix[:3, 3]
        return Shape(moved, self.facing @ rotation.T, self.faces, self.walls)


@dataclass(frozen=True, eq=False)
class Transferred:
    """weights (N, B) float32, rows sum to 1; taken (N,) bool: as the source has them, the others are inpainted; alone
    (N,) bool: inpainted ones that nothing around them holds, which have the weights of what is nearest."""

    weights: Array
    taken: Array
    alone: Array


def transfer(
    source: Shape,
    weights: Array,
    target: Shape,
    *,
    reach: float = REACH,
    angle: float = ANGLE,
    inpaint: bool = True,
    fit: bool = False,
    tick: Tick = silent,
) -> Transferred:
    """Weights of `source` (M, B), rows of any sum, for `target`, which lies in the same place in the same pose.

    Each point takes the weights of the closest point on the mesh, or of the splats nearest to it. Where that is
    further than `reach`, a share of the source's diagonal, or faces another way by more than `angle` degrees, such as
    a thigh behind a hand, it takes the harmonic continuation of the others' weights over the target's graph instead
    (Abdrashitov et al. 2023, with Laplace's equation, whose solution has no negative weights). Without `inpaint` all
    keep what is nearest. With `fit` the source is first brought onto the target, see `align`.

    Raises:
        InputError: the source has no weights, or lies elsewhere: nothing matches.
    """
    weights = np.asarray(weights, np.float32)
    if not (weights.sum(axis=1) > 1e-6).any():
        raise InputError("The source has no weights for these bones; give it some, or rename its groups.")
    if fit:
        source = source.fitted(target, reach, stretch(tick, 0.0, 0.2))
    if source.faces is None:
        found = among_points(
            target.points, target.facing, source.points, source.facing, weights, reach=reach, angle=angle,
            tick=stretch(tick, 0.2, 0.5),
        )  # fmt: skip
    else:
        found = on_surface(
            target.points, target.facing, source.points, source.faces, source.facing, weights, reach=reach, angle=angle,
            piece=source.pieces,
        )  # fmt: skip
    tick(0.5)
    if not found.sure.any():
        raise InputError(
            "Nothing of the target lies on the source; bring both into the same place, size and rest pose, or widen "
            "the reach."
        )
    return _inpainted(found, target, inpaint, stretch(tick, 0.5, 1.0))


def _inpainted(found: Match, target: Shape, inpaint: bool, tick: Tick) -> Transferred:
    weights, alone = found.weights, ~found.sure
    if inpaint:
        weights, alone = follow_neighbours(weights, target.graph, ~found.sure, tick=tick)
    # What lies where the source has no weights at all follows the nearest that is sure.
    empty = weights.sum(axis=1) < 0.5
    if empty.any():
        weights[empty] = among_points(
            target.points[empty], None, target.points[found.sure], None, weights[found.sure], nearest=1
        ).weights
    return Transferred(weights, found.sure, alone)


def _spread(mesh: Shape, count: int = 20_000) -> tuple[Array, Array]:
    """Points (C, 3) spread over a mesh by area, and their facing (C, 3)."""
    faces = np.asarray(mesh.faces)
    corner = mesh.points[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    rng = np.random.default_rng(0)
    place = (np.arange(count) + rng.random(count)) / count * area.sum()
    face = np.searchsorted(np.cumsum(area), place).clip(0, len(faces) - 1)
    root, other = np.sqrt(rng.random(count)), rng.random(count)
    bary = np.stack([1 - root, root * (1 - other), root * other], axis=1)
    return tuple(np.einsum("nk,nkd->nd", bary, values[faces[face]]) for values in (mesh.points, mesh.facing))


def _first_there(points: Array) -> Array:
    """(N,) for each of points (N, 3) the first that is in exactly the same place."""
    order = np.lexsort((np.arange(len(points)), *points.T))
    ordered = points[order]
    fresh = np.ones(len(points), bool)
    fresh[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    out = np.empty(len(points), np.int64)
    out[order] = order[fresh][np.cumsum(fresh) - 1]
    return out


def _without_contacts(graph: BodyGraph, facing: Array) -> BodyGraph:
    """The graph without the ways between points that face one another, where two parts of a body touch."""
    opposed = np.zeros(graph.neighbour.shape, bool)
    for k in range(graph.neighbour.shape[1]):
        opposed[:, k] = np.einsum("nk,nk->n", facing, facing[graph.neighbour[:, k]]) < -0.25
    own = np.arange(len(facing))[:, None]
    length = np.where(opposed, np.inf, graph.length).astype(np.float32)
    return BodyGraph(np.where(opposed, own, graph.neighbour), length)
