# SPDX-License-Identifier: GPL-3.0-or-later
"""Bone heat on splats: the equilibrium of the bones' pull on a neighbour graph (Baran & Popovic 2007)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..splats.cloud import SplatCloud
from ..ticks import Tick, silent
from .laplacian import GraphLaplacian
from .node_graph import NodeGraph, build_graph

HANDLE_STRENGTH = 3.0
NORMAL_WEIGHTED_STRENGTH = 6.0
"""Strength of handles with `normal_weighted_distances`: with 4, 6 and 9 the heat weights keep 0.659, 0.641 and 0.641
of the initial weights' error on 83 assets, and on the animals among them 0.577, 0.584 and 0.599."""

TIES = 1.0001
CLOSEST = 1e-3
"""Distances below this share of the diagonal count as this."""


class BoneHeat:
    """A graph of nodes on the splats that hangs on its bones.

    Each node i is held by its nearest bone b(i) with the strength h_i = strength m_i / d_i^2: d_i is the distance to
    that bone, m_i a quarter of the summed squared edges, which makes the balance independent of how densely the nodes
    lie. The handles close to their bone are thereby firm, the doubtful ones far from all bones are carried by their
    neighbours.

    graph: the nodes; rest (M, 3); handle_bone (M, B): the bones that hold each node, rows sum to 1; handle_strength
    (M,); laplacian of the graph; equilibrium (M, B): the heat of each bone at each node, with which laplacian +
    diag(handle_strength) balances the handles.
    """

    def __init__(
        self,
        cloud: SplatCloud,
        distances: NDArray[Any],
        *,
        handle_distances: NDArray[Any] | None = None,
        strength: float = HANDLE_STRENGTH,
        nodes: int = 3000,
        graph: NodeGraph | None = None,
        walls: NDArray[Any] | None = None,
        tick: Tick = silent,
    ) -> None:
        """cloud: N splats; distances (N, B): from each splat to each bone, through the body, metres;
        handle_distances (N, B): by which the handles are held, `distances` by default, see
        `normal_weighted_distances`; strength of the handles; graph of `cloud` and
        `distances`, ready made, or how many nodes and which walls (N,) to make it with, see `build_graph`."""
        self.graph: NodeGraph = build_graph(cloud.means, distances, nodes, walls=walls) if graph is None else graph
        self.rest = cloud.means[self.graph.nodes].astype(np.float64)
        a, b = self.graph.edges.T
        count = len(self.rest)
        square = np.square(self.rest[a] - self.rest[b]).sum(1)
        square = np.minimum(square, 4 * np.median(square))  # bridges across gaps are no measure of density
        mass = (np.bincount(a, square, count) + np.bincount(b, square, count)) / 4
        pulling = distances if handle_distances is None else handle_distances
        near = np.maximum(np.asarray(pulling[self.graph.nodes], np.float64), CLOSEST * diagonal(cloud))
        nearest = near.min(axis=1, keepdims=True)
        bone = near <= nearest * TIES
        self.handle_bone = bone / bone.sum(axis=1, keepdims=True)
        self.handle_strength = strength * mass / nearest[:, 0] ** 2
        self.laplacian = GraphLaplacian(count, self.graph.edges)
        self.equilibrium = self._balance(self.handle_strength, None, tick)

    def _balance(self, handles: NDArray[Any], guess: NDArray[Any] | None, tick: Tick) -> NDArray[Any]:
        """(M, B) heat with handles of the strengths (M,)."""
        return self.laplacian.solve(handles, handles[:, None] * self.handle_bone, guess, tick)

    def weights(self, strength: float = 1.0, tick: Tick = silent) -> NDArray[np.float32]:
        """The equilibrium as weights (N, B) of the splats, rows sum to 1.

        Handles of another `strength`, as a part of the usual one, give wider (below 1) or narrower transitions.
        """
        heat = self.equilibrium
        if strength != 1.0:
            heat = self._balance(strength * self.handle_strength, heat, tick)
        blended = np.einsum("nk,nkb->nb", self.graph.anchor_weight, heat[self.graph.anchor])
        blended = np.maximum(blended, 0)
        return (blended / blended.sum(axis=1, keepdims=True)).astype(np.float32)


def diagonal(cloud: SplatCloud) -> float:
    """Length of the diagonal of the splats' bounding box."""
    lower, upper = cloud.bounds()
    return float(np.linalg.norm(upper - lower))
