# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh-anchored splats (Eq. 4-5): splats that follow the triangles of a proxy mesh. numpy only."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..splats.cloud import SplatCloud
from ..splats.sh import rotate_sh as rotate_coefficients
from .covariance import transform_gaussians
from .nearest import nearest_triangles
from .quaternion import nearest_rotation
from .triangles import THINNEST, check_mesh, face_frames, triangle_quality
from .vertex_maps import vertex_transforms

Array = NDArray[Any]

BETA = 0.5
"""Largest normal offset of Eq. 4, in circumradii."""

GROWTH = 1.5
"""How much more than its size (the root of its area) a posed triangle's circumradius may grow.

A triangle stretched to a needle has an endless circumradius, and Eq. 4 would shoot its splats off the body.
Stretches of up to 2.7 and all similarities stay below.
"""

FARTHEST = 0.1
"""Mean distance to the proxy mesh, in diagonals of the splats, beyond which it cannot be theirs."""


@dataclasses.dataclass(frozen=True, eq=False)
class Anchors:
    """Where N splats hang on a mesh.

    face:     (N,) int64 triangle.
    bary:     (N, 3) float64 barycentric coordinates of the foot point, >= 0, sum 1.
    beta:     (N,) float64 offset along the normal in circumradii, within [-0.5, 0.5].
    residual: (N, 3) float64 what Eq. 4 leaves out at rest, in the triangle's frame (`face_frames`) and in
              circumradii: the clamped part of the offset, and the sideways part where the nearest point lies on an
              open or convex edge. It moves with the triangle. Zero when anchored with keep_residual=False.
    reach:    (N,) float64 largest posed circumradius over the root of the doubled area (see `GROWTH`).
    miss:     (N,) float64 how far Eq. 4 alone misses the rest centre, in the mesh's unit.
    """

    face: Array
    bary: Array
    beta: Array
    residual: Array
    reach: Array
    miss: Array

    @property
    def count(self) -> int:
        """Number of splats N."""
        return len(self.face)

    @property
    def clamped(self) -> Array:
        """(N,) bool: splats farther along the normal than Eq. 4 allows."""
        return np.abs(self.beta) >= BETA

    def select(self, index: Any) -> Anchors:
        """The anchors at `index` (integers, mask or slice)."""
        names = [field.name for field in dataclasses.fields(self)]
        return Anchors(**{name: getattr(self, name)[index] for name in names})

    def summary(self) -> dict[str, float]:
        """Numbers for a report: how well the mesh holds the splats."""
        return {
            "clamped": int(self.clamped.sum()),
            "mean_miss": float(self.miss.mean()) if self.count else 0.0,
            "largest_miss": float(self.miss.max(initial=0)),
        }


def anchor_splats(
    means: ArrayLike,
    verts: ArrayLike,
    faces: ArrayLike,
    *,
    keep_residual: bool = True,
    growth: float = GROWTH,
    label: str = "the proxy mesh",
) -> Anchors:
    """Anchor every splat to its nearest triangle (Eq. 4).

    means (N, 3) and verts (V, 3) in the same space at rest, faces (F, 3). The search is exact; triangles too thin
    to carry anything are passed over. beta is clamped to [-0.5, 0.5] as the paper has it. With `keep_residual` the
    rest centres are nevertheless met exactly, otherwise splats beyond move onto that limit. `growth` bounds the
    posed circumradius; a large one (1e9) gives Eq. 4 to the letter.

    Raises:
        InputError: a mesh that cannot carry splats (see `check_mesh`), centres that are not finite.
    """
    points = np.asarray(means, dtype=np.float64)
    vertices, triangles = check_mesh(verts, faces, label)
    if not np.isfinite(points).all():
        raise InputError("The splats have centres that are not finite numbers; import them without those.")
    solid = np.flatnonzero(triangle_quality(vertices, triangles) > THINNEST)
    index, bary = nearest_triangles(points, vertices[triangles[solid]])
    face = solid[index]
    corner = vertices[triangles[face]]
    frames, radius, double = face_frames(vertices, triangles[face])
    offset = points - np.einsum("nk,nkd->nd", bary, corner)
    local = np.einsum("nij,ni->nj", frames, offset) / radius[:, None]
    beta = np.clip(local[:, 2], -BETA, BETA)
    residual = local.copy()
    residual[:, 2] -= beta
    # Where the foot lies inside, the sideways part is rounding.
    residual[np.abs(residual) < 1e-12] = 0
    miss = np.linalg.norm(residual, axis=1) * radius
    kept = residual if keep_residual else np.zeros_like(residual)
    return Anchors(face, bary, beta, kept, growth * radius / np.sqrt(double), miss)


def check_fit(anchors: Anchors, means: ArrayLike, verts: Array, faces: Array, label: str = "the proxy mesh") -> None:
    """Raise InputError where the splats do not lie on the mesh: another place, unit or axis."""
    points = np.asarray(means, dtype=np.float64)
    foot = np.einsum("nk,nkd->nd", anchors.bary, np.asarray(verts)[np.asarray(faces)[anchors.face]])
    distance = float(np.median(np.linalg.norm(points - foot, axis=1)))
    low, high = np.percentile(points, [1, 99], axis=0)
    diagonal = float(np.linalg.norm(high - low))
    if distance > FARTHEST * diagonal > 0:
        raise InputError(
            f"{label[:1].upper() + label[1:]} does not fit the splats: half of them are more than "
            f"{distance / diagonal:.0%} of their size away from it; bring both to the same place, size and axes."
        )


def anchored_points(anchors: Anchors, posed_verts: Array, faces: Array) -> Array:
    """Centres (..., N, 3) by Eq. 4 with posed normals and circumradii (bounded, see `GROWTH`).

    posed_verts (..., V, 3), faces (F, 3).
    """
    posed = np.asarray(posed_verts, dtype=np.float64)
    triangles = np.asarray(faces)[anchors.face]
    frames, radius, double = face_frames(posed, triangles)
    radius = np.minimum(radius, anchors.reach * np.sqrt(double))
    local = anchors.residual + anchors.beta[:, None] * np.array([0.0, 0.0, 1.0])
    out: Array = np.einsum("nk,...nkd->...nd", anchors.bary, posed[..., triangles, :])
    out += np.einsum("...nij,nj->...ni", frames, local) * radius[..., None]
    return out


def splat_maps(anchors: Anchors, rotation: Array, shear: Array, faces: Array) -> Array:
    """T (N, 3, 3) of Eq. 5: R and S (V, 3, 3) blended by the barycentrics separately, then multiplied."""
    triangles = np.asarray(faces)[anchors.face]
    blended = [np.einsum("nk,nkij->nij", anchors.bary, each[triangles]) for each in (rotation, shear)]
    return blended[0] @ blended[1]


def pose_anchored(
    cloud: SplatCloud,
    anchors: Anchors,
    verts: Array,
    posed_verts: Array,
    faces: Array,
    *,
    rotate_sh: bool = True,
    edges_only: bool = False,
) -> SplatCloud:
    """The cloud on the posed mesh: centres by Eq. 4, covariances by Eq. 5, SH turned by the rotation of each T.

    verts, posed_verts (V, 3); faces (F, 3); edges_only: see `vertex_maps.rest_rings`. The general covariance
    T Sigma T^T comes back as rotation and scales, axes in the order of the rest splats.
    """
    rotation, shear = vertex_transforms(verts, posed_verts, faces, edges_only=edges_only)
    maps = splat_maps(anchors, rotation, shear, faces)
    quats, scales = transform_gaussians(cloud.quats, cloud.scales, maps)
    sh = cloud.sh
    if rotate_sh and sh.shape[1] > 1:
        sh = rotate_coefficients(sh, nearest_rotation(maps))
    means = anchored_points(anchors, posed_verts, faces)
    return dataclasses.replace(
        cloud,
        means=means.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=scales.astype(np.float32),
        sh=sh,
        stored={},
    )
