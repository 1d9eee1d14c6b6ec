# SPDX-License-Identifier: GPL-3.0-or-later
"""A job's proxy mesh: its vertices have the weights, the splats are anchored to its triangles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..job.mesh_files import read_mesh
from ..render.camera import Camera
from ..rig.anchoring import Anchors, anchor_splats, check_fit
from ..rig.mesh_weights import splat_weights
from ..rig.skeleton import Skeleton
from ..skinning.extent import unit_frame
from ..skinning.initial import initial_with_confidence
from ..skinning.posers import NEIGHBOURS, AnchoredPoser
from ..skinning.subset import SplatSubset
from ..splats.cloud import SplatCloud

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Proxy:
    """verts (V, 3) and faces (F, 3) in unit size, and the anchors of all splats on them; edges_only: see
    `vertex_maps.rest_rings`."""

    verts: Array
    faces: Array
    anchors: Anchors
    edges_only: bool = False

    @classmethod
    def load(cls, path: Path, cloud: SplatCloud, *, edges_only: bool = False) -> Proxy:
        """The mesh file at `path`, in the world of `cloud` (as the job has it).

        Raises:
            InputError: no such file, a mesh that cannot carry splats, or one that lies elsewhere.
        """
        verts, faces = read_mesh(path)
        centre, diagonal = unit_frame(cloud.means)
        verts = (verts - centre) / diagonal
        means = (cloud.means - centre) / diagonal
        anchors = anchor_splats(means, verts, faces, label=f"'{path}'")
        check_fit(anchors, means, verts, faces, f"'{path}'")
        return cls(verts, faces, anchors, edges_only)

    def initial(
        self,
        name: str,
        cloud: SplatCloud,
        skeleton: Skeleton,
        masks: Array,
        cameras: Sequence[Camera],
        options: Mapping[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Initial weights (V, B) of the vertices by the method `name`, in a body of the splats `cloud`; with their
        confidence (V,), where the method has one.

        The vertices join the splats as small splats, with the colour of the nearest: a method sees one body.
        """
        from scipy.spatial import cKDTree

        count = len(self.verts)
        size = np.full((count, 3), np.median(cloud.scales), np.float32)
        both = SplatCloud(
            np.concatenate([cloud.means, self.verts]),
            np.concatenate([cloud.quats, np.eye(1, 4, dtype=np.float32).repeat(count, axis=0)]),
            np.concatenate([cloud.scales, size]),
            np.concatenate([cloud.opacities, np.ones(count, np.float32)]),
            np.concatenate([cloud.sh[:, :1], cloud.sh[cKDTree(cloud.means).query(self.verts)[1], :1]]),
        )
        weights, confidence = initial_with_confidence(name, both, skeleton, masks, cameras, options)
        return weights[cloud.count :], None if confidence is None else confidence[cloud.count :]

    def to_splats(self, weights: NDArray[np.float32], normalised: bool = True) -> NDArray[np.float32]:
        """Weights (N, B) of all splats from those of the vertices (V, B); or other values, not `normalised`."""
        values = splat_weights(self.anchors, weights, self.faces)
        return values / values.sum(axis=1, keepdims=True) if normalised else values

    def poser(self, subset: SplatSubset, neighbours: int = NEIGHBOURS) -> AnchoredPoser:
        """The poser of the splats that are optimised; neighbours: of each vertex, for ARAP."""
        anchors = self.anchors.select(subset.index)
        return AnchoredPoser(
            subset.cloud, anchors, self.verts, self.faces, neighbours, edges_only=self.edges_only
        )

    def summary(self) -> dict[str, float]:
        """Numbers for the report; distances in parts of the object's size."""
        counts = {"vertices": len(self.verts), "faces": len(self.faces), "edges_only": self.edges_only}
        return {**counts, **self.anchors.summary()}
