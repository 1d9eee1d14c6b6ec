# SPDX-License-Identifier: GPL-3.0-or-later
"""The judge of mesh-anchored splats (paper, Sec. III-A and Table II): the mesh moves, the splats hang on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.assets import RiggedSplats
from gskin_addon.core.rig.anchoring import anchor_splats, pose_anchored
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.rig.mesh_weights import splat_weights
from gskin_addon.core.training.rigged import RiggedMesh

from .judge import Judge, Score
from .lpips import Perceptual
from .methods.heat import weld
from .protocol import Protocol

Array = NDArray[Any]

NEIGHBOURS = 4
"""Splats whose weights a vertex takes, by inverse distance, where a method has weights of splats only."""


class AnchoredJudge(Judge):
    """Pictures of splats on the asset's own mesh, welded, which weights of its vertices move (Eq. 4-5).

    Weights may be those of the W vertices of `mesh`, or of the N splats; of these the vertices take the nearest
    ones'. The truth has the artist's weights on the vertices. Position errors are those of the splats' weights.
    """

    def __init__(
        self, asset: RiggedSplats, rigged: RiggedMesh, protocol: Protocol, lpips: Perceptual | None = None
    ) -> None:
        verts, faces, new = welded(asset)
        self.mesh = verts, faces
        self._anchors = anchor_splats(asset.cloud.means, verts, faces)
        columns = [rigged.skeleton.names.index(name) for name in asset.skeleton.names]
        self._mesh_truth = np.zeros((len(verts), len(columns)))
        self._mesh_truth[new] = rigged.weights[:, columns]
        self._mesh_truth /= np.maximum(self._mesh_truth.sum(axis=1, keepdims=True), 1e-12)
        distance, self._near = cKDTree(asset.cloud.means).query(verts, NEIGHBOURS)
        share = 1 / np.maximum(distance, 1e-9)
        self._share = share / share.sum(axis=1, keepdims=True)
        super().__init__(asset, protocol, lpips)

    def score(self, weights: Array) -> Score:
        """The score of weights (W, B) of the mesh's vertices or (N, B) of the splats. ValueError for others."""
        weights = np.asarray(weights, np.float64)
        if len(weights) == len(self.mesh[0]):
            return self._score(splat_weights(self._anchors, weights, self.mesh[1]), weights)
        return self._score(weights, self.to_vertices(weights))

    def to_vertices(self, weights: Array) -> Array:
        """Weights (W, B) of the vertices from those of the splats (N, B)."""
        return np.asarray(np.einsum("vk,vkb->vb", self._share, weights[self._near]))

    def render(self, weights: Array, frame: int) -> list[NDArray[np.float32]]:
        """The pictures of one frame with weights (W, B) of the vertices, one for each camera."""
        verts, faces = self.mesh
        posed = skin_points(verts, weights, self.frames[frame][None])[0]
        cloud = pose_anchored(self._asset.cloud, self._anchors, verts, posed, faces, rotate_sh=False)
        return self._render(cloud)

    def _true_weights(self) -> Array:
        return self._mesh_truth


def welded(asset: RiggedSplats) -> tuple[Array, Array, Array]:
    """The asset's mesh as it carries splats: verts (W, 3), faces (G, 3), and the new vertex of each old one.

    Raises:
        ValueError: the splats come from no mesh.
    """
    if asset.surface is None:
        raise ValueError(f"the splats of '{asset.name}' come from no mesh")
    return weld(asset.surface.verts, asset.surface.faces)
